"""A wavy sheet under a light beside the lens, five views of it, and a short fit."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.fit.stage import FitConfig
from stages.splatting.light import LitScene
from stages.splatting.rasterizer import Viewpoint, rasterize
from stages.splatting.rendering import render
from tests.stages import fit_case

WIDTH, HEIGHT = 96, 72
looking = partial(fit_case.looking, width=WIDTH, height=HEIGHT)
TRUTH = {"diffuse_share": 0.8, "falloff": 2.0, "widths": (60.0, 12.0), "strengths": (0.4, 0.05)}


def bump(count: int, seed: int) -> Points:
    """A wavy sheet 100 units from the cameras, smoothly coloured."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-45, 45, (2, count))
    z = 100 + 3 * np.sin(x / 9) * np.cos(y / 11)
    normals = np.stack(
        [np.cos(x / 9) * np.cos(y / 11) / 3, -3 * np.sin(x / 9) * np.sin(y / 11) / 11,
         -np.ones(count)], 1,
    )  # fmt: skip
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = 0.45 + 0.2 * np.stack([np.sin(x / 15), np.cos(y / 14), np.sin((x + y) / 17)], 1)
    columns = (np.stack([x, y, z], 1), colors, normals, np.full(count, 5.0), np.zeros(count))
    return Points(*(column.astype(np.float32) for column in columns))


def lit_image(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    packed = LitScene(gaussians).seen_from(camera.centre)
    planes = rasterize(packed, Viewpoint.of(camera), degree=0, near=1.0).planes[:3]
    return np.clip(planes.transpose(1, 2, 0), 0, 1)


def case(lit: bool, shine: float = 1.0) -> tuple[Views, Cameras, Points, Gaussians]:
    """Five views of the sheet, under a moving flash or painted in fixed colours."""
    narrow, broad = TRUTH["strengths"]
    truth = TRUTH | {"strengths": (shine * narrow, shine * broad)}
    dense = bump(9000, 1)
    count = len(dense)
    gaussians = Gaussians(
        dense.positions, np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), np.log(0.7), np.float32), np.full(count, 3.0, np.float32),
        np.zeros((count, 16, 3), np.float32),
        Light(dense.colors, dense.normals, distance=100.0, **truth),
    )  # fmt: skip
    gaussians.sh[:, 0] = (dense.colors - 0.5) / 0.28209479177387814
    cameras = [looking(angle, f"{i:03d}") for i, angle in enumerate(np.linspace(-0.5, 0.5, 5))]
    draw = (
        lit_image
        if lit
        else (lambda g, c: np.clip(render(dataclasses.replace(g, light=None), c).image, 0, 1))
    )
    views = tuple(View(c.name, draw(gaussians, c).astype(np.float32)) for c in cameras)
    points = bump(2500, 2)
    # the colours that photographs show: too bright where light fell straight
    return Views(views), Cameras(tuple(cameras)), points, gaussians


def context(tmp_path, views, cameras, points, threads=2, **config):
    config = {
        "iterations": 150, "initial_points": 2500, "optimize_poses": False, "densify": False,
        "light_trial_iterations": 40, "light_trial_factor": 2, **config,
    }  # fmt: skip
    inputs = {"views": views, "cameras": cameras, "points": points}
    return LocalContext(FitConfig(**config), tmp_path, inputs, threads=threads, seed=3)
