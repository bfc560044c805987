"""A synthetic scene with exact flow: a textured square before a textured wall."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, to_uint8

WALL, SQUARE, HALF = 6.0, 4.5, 0.5  # depths in the world, and half the side of the square
PIXELS_PER_UNIT = 90.0


def camera(name: str, angle: float, width: int = 160, height: int = 120) -> Camera:
    """A camera on a circle of radius 5 about (0, 0, 5), looking at its centre; 0: at the origin."""
    turn = np.radians(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    centre = np.array([5 * np.sin(turn), 0, 5 - 5 * np.cos(turn)])
    pose[:3, 3] = -pose[:3, :3] @ centre
    focal = 1.3 * width
    return Camera(name, width, height, focal, focal, width / 2, height / 2, pose)


@cache
def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(900, 1200, 3)).astype(np.float32)
    image = cv2.GaussianBlur(noise, (0, 0), 3) * 3 + 2 * cv2.GaussianBlur(noise, (0, 0), 9) * 9
    return np.clip(0.45 + 0.16 * image / image.std(), 0, 1).astype(np.float32)


def look_up(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    columns = (x * PIXELS_PER_UNIT + image.shape[1] / 2 - 0.5).astype(np.float32)
    rows = (y * PIXELS_PER_UNIT + image.shape[0] / 2 - 0.5).astype(np.float32)
    return cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def photograph(camera: Camera) -> tuple[View, np.ndarray]:
    """The view, and its exact depth [H, W] (z)."""
    rays = camera.unproject(np.ones((camera.height, camera.width))) - camera.centre
    hits = [
        camera.centre + rays * ((z - camera.centre[2]) / rays[..., 2])[..., None]
        for z in (SQUARE, WALL)
    ]
    on_square = (np.abs(hits[0][..., :2]) < HALF).all(-1)
    point = np.where(on_square[..., None], hits[0], hits[1])
    colors = [look_up(texture(seed), hits[seed][..., 0], hits[seed][..., 1]) for seed in (0, 1)]
    image = np.where(on_square[..., None], colors[0], colors[1])
    depth = camera.project(point.reshape(-1, 3))[1].reshape(on_square.shape)
    eight_bit = to_uint8(image).astype(np.float32) / np.float32(255)
    return View(camera.name, eight_bit), depth.astype(np.float32)


@cache
def cloud(step: float = 0.03) -> Points:
    """Points on the square and the wall, `step` apart."""
    square = np.arange(-HALF, HALF, step) + step / 2
    wall = np.arange(-4, 4, step) + step / 2
    rows = [
        np.stack([*np.meshgrid(axis, axis), np.full((len(axis),) * 2, z)], -1).reshape(-1, 3)
        for axis, z in ((square, SQUARE), (wall, WALL))
    ]
    positions = np.concatenate(rows).astype(np.float32)
    count = len(positions)
    return Points(
        positions, np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32),
        np.ones(count, np.float32), np.full(count, step, np.float32),
    )  # fmt: skip
