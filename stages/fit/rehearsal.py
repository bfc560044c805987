"""Fits of a handful of Gaussians, so that the kernels of real ones are compiled."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from stages.fit.config import FitConfig, resolve
from stages.fit.fitting import fit
from stages.fit.numerics.objectives import flow_loss
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import Viewpoint, rasterize, use_threads

WIDTH, HEIGHT, POINTS = 48, 32, 300


def rasterizer() -> None:
    """Forward and backward."""
    use_threads(1)
    view = Viewpoint.of(_camera(0))
    packed = np.zeros((POINTS, 14), np.float32)
    packed[:, :3] = _points().positions
    packed[:, 3] = 1
    rendering = rasterize(packed, view, degree=0, near=0.1, depth=True)
    rendering.backward(np.ones_like(rendering.planes), np.ones_like(rendering.transmittance))


def whole_fits() -> None:
    """Whole fits: on a held surface with a light and without, and with neither."""
    use_threads(1)
    image, valid = _image()[..., 0], np.ones((HEIGHT, WIDTH), np.float32)
    colour = ColourLoss(np.ascontiguousarray(np.stack([image] * 3)), valid)
    colour(colour.target, 0.2)
    planes, seen = np.ones((2, HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    flow_loss(planes, seen, planes, seen, 1.0, planes.copy(), seen.copy())
    fits: tuple[tuple[bool, Literal["camera", "none"]], ...] = (
        (True, "camera"), (True, "none"), (False, "none"),
    )  # fmt: skip
    for held, light in fits:
        names = [f"{k:03}" for k in range(3)]
        cameras = [_camera(k) for k in range(3)]
        config = FitConfig(
            iterations=8, initial_points=POINTS, light=light,
            densify=not held, lambda_depth=0.1, backend="cpu",
        )  # fmt: skip
        fit(
            [View(name, _image()) for name in names], cameras, _points(), None,
            resolve(config, 3, 0, held), threads=1, checkpoint=None,
            report=lambda *_: None,
        )  # fmt: skip


def _image() -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([0.5 + 0.4 * np.sin(k + rows / 5 + columns / 7) for k in range(3)], -1).astype(
        np.float32
    )


def _camera(number: int) -> Camera:
    angle = 0.3 * (number - 1)
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)],
    ]  # fmt: skip
    pose[:3, 3] = [0, 0, 3]
    return Camera(
        f"{number:03}", WIDTH, HEIGHT, 1.2 * WIDTH, 1.2 * WIDTH, WIDTH / 2, HEIGHT / 2, pose
    )


def _points() -> Points:
    side = np.random.default_rng(0).uniform(-1, 1, (POINTS, 2))
    positions = np.column_stack([side, 0.1 * (side**2).sum(1)])
    normals = np.tile([0.0, 0.0, -1.0], (POINTS, 1))
    columns = (positions, np.full((POINTS, 3), 0.5), normals, np.full(POINTS, 3.0),
               np.full(POINTS, 0.1))  # fmt: skip
    return Points(*(column.astype(np.float32) for column in columns))
