"""A small textured surface, three views of it, and a short fit."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.fit.inputs.initial import Cloud, initial_gaussians
from stages.fit.stage import FitConfig, FitStage
from stages.splatting.rasterizer import unpack
from stages.splatting.rendering import render

WIDTH, HEIGHT = 64, 48


def surface(count: int = 3000, seed: int = 0) -> Points:
    """A bulging sheet with smooth colours, 100 units from the cameras."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-45, 45, (2, count))
    z = 100 + 0.004 * (x**2 + y**2)
    colors = 0.5 + 0.4 * np.stack([np.sin(x / 5), np.cos(y / 4), np.sin((x + y) / 7)], 1)
    normals = np.stack([0.008 * x, 0.008 * y, -np.ones(count)], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    columns = (np.stack([x, y, z], 1), colors, normals, np.ones(count), np.zeros(count))
    return Points(*(column.astype(np.float32) for column in columns))


def looking(angle: float, name: str, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """A camera that circles about (0, 0, 100)."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    matrix[:3, 3] = np.array([0, 0, 100]) - matrix[:3, :3] @ [0, 0, 100]
    return Camera(name, width, height, 1.2 * width, 1.2 * width, width / 2, height / 2, matrix)


def case(**sizes: tuple[int, int]) -> tuple[Views, Cameras, Points]:
    """Three views, painted by splatting a dense version of the surface."""
    cameras = [
        looking(angle, name, *sizes.get(f"v{name}", (WIDTH, HEIGHT)))
        for angle, name in ((-0.25, "000"), (0.0, "001"), (0.25, "002"))
    ]
    dense = surface(8000, 1)
    cloud = Cloud(
        *(np.asarray(a, np.float64) for a in (dense.positions, dense.colors, dense.normals)),
        np.ones(len(dense)),
    )
    truth = unpack(
        initial_gaussians(
            cloud, cameras, opacity=0.95, scale=1.0, scale_max_px=6, degree=0, headlight=0,
            shoulder=0,
        )
    )  # fmt: skip
    images = [np.clip(render(truth, camera, threads=1).image, 0, 1) for camera in cameras]
    views = tuple(View(c.name, image) for c, image in zip(cameras, images, strict=True))
    return Views(views), Cameras(tuple(cameras)), surface()


def context(tmp_path, views, cameras, points, flow=None, threads=2, **config):
    inputs = {"views": views, "cameras": cameras, "points": points}
    if flow is not None:
        inputs["flow"] = flow
    config = {"iterations": 60, "initial_points": 1500, "light_trial_iterations": 30, **config}
    return LocalContext(FitConfig(**config), tmp_path, inputs, threads=threads, seed=3)


def outputs(folder) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for kind in ("gaussians", "cameras")
        for path in sorted((folder / kind).rglob("*"))
    }


class StoppedError(Exception):
    pass


def run_until(here: LocalContext, iteration: int) -> None:
    """Run a fit that is stopped once it says that so many iterations are done."""

    def stop(step: str, done: int, total: int, **figures: object) -> None:
        if step == "fit" and done >= iteration:
            raise StoppedError

    here.on_progress = stop
    with pytest.raises(StoppedError):
        FitStage().run(here)
