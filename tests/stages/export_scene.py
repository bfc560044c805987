"""A small scene with known truth for the export tests: a ball in front of three cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from stages.splatting.rendering import render

RADIUS = 1.0
WIDTH, HEIGHT = 160, 120
SOURCE = "Smith_John.jpg"


def ball_cameras() -> tuple[Camera, ...]:
    """Three cameras 4 away at -35, 0 and 35 degrees; the world is y-down, as the pictures are."""
    cameras = []
    for index, degrees in enumerate((-35.0, 0.0, 35.0)):
        a = np.radians(degrees)
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
        pose[:3, 3] = [0.05 * index, 0.02, 4.0]
        cameras.append(Camera(f"{index:03d}", WIDTH, HEIGHT, 200.0, 204.0, 82.0, 59.0, pose))
    return tuple(cameras)


def ball_gaussians(count: int = 1500, degree: int = 1) -> Gaussians:
    """Flat Gaussians on a ball, coloured by place (nothing symmetric), brighter at the front."""
    golden = np.pi * (3 - np.sqrt(5))
    step = np.arange(count)
    z = 1 - (2 * step + 1) / count
    ring = np.sqrt(1 - z**2)
    normals = np.stack([ring * np.cos(golden * step), ring * np.sin(golden * step), z], 1)
    quats = np.concatenate([1 + normals[:, 2:], np.cross([0, 0, 1.0], normals)], 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    spacing = np.sqrt(4 * np.pi / count)
    log_scales = np.log(np.tile([0.7 * spacing, 0.5 * spacing, 0.1 * spacing], (count, 1)))
    sh = np.zeros((count, 16, 3))
    sh[:, 0, 0] = 1.4 * normals[:, 0]
    sh[:, 0, 1] = 1.2 * np.sin(5 * normals[:, 1])
    sh[:, 0, 2] = -1.0 * normals[:, 2] + 0.5 * normals[:, 1]
    random = np.random.default_rng(3)
    used = (degree + 1) ** 2
    sh[:, 1:used] = 0.15 * random.standard_normal((count, used - 1, 3))
    return Gaussians(
        means=(RADIUS * normals).astype(np.float32),
        quats_wxyz=quats.astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        logit_opacities=random.uniform(1.5, 5.0, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def lit_ball(count: int = 1500) -> Gaussians:
    """The ball with a light beside the lens: it says something else than its harmonics."""
    ball = ball_gaussians(count)
    normals = ball.means / np.linalg.norm(ball.means, axis=1, keepdims=True)
    albedo = np.clip(0.5 + 0.4 * normals[:, [1, 2, 0]], 0.05, 0.95).astype(np.float32)
    light = Light(
        albedo, normals.astype(np.float32), diffuse_share=0.8, falloff=1.5, distance=3.0,
        widths=(60.0, 12.0), strengths=(0.5, 0.05),
    )  # fmt: skip
    return replace(ball, light=light)


def ball_points() -> Points:
    gaussians = ball_gaussians()
    count = len(gaussians)
    return Points(
        positions=gaussians.means,
        colors=np.clip(0.5 + 0.2821 * gaussians.sh[:, 0], 0, 1),
        normals=gaussians.means / np.float32(RADIUS),
        confidence=np.full(count, 3, np.float32),
        scale=np.full(count, 0.1, np.float32),
    )


def ball_case() -> dict:
    """The artifacts of the case: views (with telling source names), cameras, gaussians, points."""
    cameras, gaussians = ball_cameras(), ball_gaussians()
    views = tuple(
        View(
            name=camera.name,
            image=np.clip(render(gaussians, camera).image, 0, 1),
            source_name=SOURCE,
            source_sha256="5ec2e7",
            focal_px=200.0,
        )
        for camera in cameras
    )
    lost = View(name="003", image=views[0].image[:, ::-1], source_name=SOURCE)
    return {
        "views": Views((*views, lost)),
        "cameras": Cameras(cameras),
        "gaussians": gaussians,
        "points": ball_points(),
    }


def ball_depth(camera: Camera) -> np.ndarray:
    """Exact depth of the unit ball, 0 beside it."""
    direction = camera.unproject(np.ones((camera.height, camera.width))) - camera.centre
    b = direction @ camera.centre
    a = (direction**2).sum(-1)
    root = b**2 - a * (camera.centre @ camera.centre - 1)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
