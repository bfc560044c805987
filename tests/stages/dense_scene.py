"""A small textured scene with exact depth: a ball before a wavy wall, seen from an arc."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.cameras import Camera

BALL = np.array([0.0, 0.0, 3.6])
RADIUS = 0.7


def camera(name: str, degrees: float, width: int = 128, height: int = 96) -> Camera:
    """A camera on an arc around (0, 0, 4), 4 away, looking at it."""
    a = np.radians(degrees)
    rotation = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    centre = np.array([0, 0, 4.0]) - 4 * rotation[2]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    focal = 1.3 * width
    return Camera(name, width, height, focal, focal, width / 2, height / 2, pose)


def texture(points: np.ndarray) -> np.ndarray:
    """Colour [..., 3] in 0..1 of surface points [..., 3]: many fixed sine waves in space."""
    rng = np.random.default_rng(7)
    waves = rng.normal(size=(40, 3)) * rng.uniform(3, 14, size=(40, 1))
    phases = rng.uniform(0, 2 * np.pi, 40)
    weights = rng.normal(size=(40, 3)) / np.sqrt(40)
    return np.clip(0.45 + 0.22 * (np.sin(points @ waves.T + phases) @ weights), 0, 0.85)


def render(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] float32 and exact z-depth [H, W] float32."""
    direction = view.unproject(np.ones((view.height, view.width))) - view.centre
    # The wall z = 4.6 + 0.1 sin(3 x): a few steps of fixed-point iteration.
    t = np.full(direction.shape[:2], 4.0)
    for _ in range(60):
        x = view.centre[0] + t * direction[..., 0]
        t = (4.6 + 0.1 * np.sin(3 * x) - view.centre[2]) / direction[..., 2]
    offset = view.centre - BALL
    a = (direction**2).sum(-1)
    b = (direction * offset).sum(-1)
    root = b**2 - a * (offset @ offset - RADIUS**2)
    ball = (-b - np.sqrt(np.maximum(root, 0))) / a
    depth = np.where(root > 0, np.minimum(ball, t), t)
    points = view.centre + depth[..., None] * direction
    return texture(points).astype(np.float32), depth.astype(np.float32)


def scene(
    degrees: tuple[float, ...], sizes: tuple[tuple[int, int], ...] | None = None
) -> tuple[list[Camera], list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Cameras, images, depths and 60 visible points per view."""
    sizes = sizes or ((128, 96),) * len(degrees)
    cameras = [
        camera(f"{k:03d}", angle, *size)
        for k, (angle, size) in enumerate(zip(degrees, sizes, strict=True))
    ]
    rendered = [render(view) for view in cameras]
    rng = np.random.default_rng(3)
    sparse = []
    for view, (_, depth) in zip(cameras, rendered, strict=True):
        world = view.unproject(depth).reshape(-1, 3)
        sparse.append(world[rng.choice(len(world), 60, replace=False)].astype(np.float32))
    images = [image for image, _ in rendered]
    return cameras, images, [depth for _, depth in rendered], sparse
