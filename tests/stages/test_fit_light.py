"""The fit with a light beside the lens: recovery, choice, and the harmonics for other viewers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.fit.stage import FitConfig, FitStage
from stages.splatting import render
from stages.splatting.light import lit_scene
from stages.splatting.rasterizer import Viewpoint, rasterize

WIDTH, HEIGHT = 96, 72
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


def looking(angle: float, name: str) -> Camera:
    """A camera that circles about (0, 0, 100)."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    matrix[:3, 3] = np.array([0, 0, 100]) - matrix[:3, :3] @ [0, 0, 100]
    return Camera(name, WIDTH, HEIGHT, 1.2 * WIDTH, 1.2 * WIDTH, WIDTH / 2, HEIGHT / 2, matrix)


def lit_image(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    packed = lit_scene(gaussians, camera.centre)
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
        "light_trial_iterations": 40, "light_trial_factor": 2, "light_sh_iterations": 30, **config,
    }  # fmt: skip
    inputs = {"views": views, "cameras": cameras, "points": points}
    return LocalContext(FitConfig(**config), tmp_path, inputs, threads=threads, seed=3)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_a_moving_flash_is_found_and_predicts_unseen_views(tmp_path) -> None:
    views, cameras, points, truth = case(lit=True)
    lit = context(tmp_path / "lit", views, cameras, points, light="auto")
    FitStage().run(lit)
    assert lit.figures["light"] == "camera"
    assert lit.figures["light_trial_camera"] > lit.figures["light_trial_none"] + 0.5
    plain = context(tmp_path / "plain", views, cameras, points, light="none")
    FitStage().run(plain)
    found, without = lit.result("gaussians"), plain.result("gaussians")
    assert found.light is not None and without.light is None
    assert found.light.diffuse_share == pytest.approx(0.8, abs=0.15)
    assert 95 < found.light.distance < 110  # world units, about the median depth
    unseen = looking(0.13, "unseen")
    wanted = lit_image(truth, unseen)
    by_light = psnr(lit_image(found, unseen), wanted)
    assert by_light > psnr(np.clip(render(without, unseen).image, 0, 1), wanted) + 2
    # other viewers, which know the harmonics only, still show the scene
    standard = np.clip(render(dataclasses.replace(found, light=None), unseen).image, 0, 1)
    assert psnr(standard, wanted) > 19
    assert found.sh[:, 1:4].any()


def test_fixed_colours_are_not_taken_for_a_light(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    here = context(tmp_path, views, cameras, points, light="auto", iterations=20)
    FitStage().run(here)
    assert here.figures["light"] == "none"
    assert here.result("gaussians").light is None


def test_on_a_held_surface_the_shading_tells_which_light_it_was(tmp_path) -> None:
    for lit in (True, False):
        # as over most of a jaw, highlights are no more than spots
        views, cameras, points, _ = case(lit=lit, shine=0.1)
        few = Views(views=(views.views[0], views.views[2], views.views[4]))
        here = context(tmp_path / str(lit), few, cameras, points, light="auto", iterations=20,
                       hold_surface=True)  # fmt: skip
        FitStage().run(here)
        assert here.figures["light"] == ("camera" if lit else "none")
        share = here.figures["light_error_camera"] / here.figures["light_error_none"]
        assert share < 0.7 if lit else share > 0.9


def test_nothing_is_concluded_where_no_surface_is_shared(tmp_path) -> None:
    views, cameras, points, _ = case(lit=True)
    apart = []
    for view, side in ((views.views[0], slice(0, 40)), (views.views[4], slice(56, WIDTH))):
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[:, side] = True
        apart.append(View(view.name, view.image, mask))
    here = context(tmp_path, Views(tuple(apart)), cameras, points, light="auto", iterations=20,
                   hold_surface=True)  # fmt: skip
    FitStage().run(here)
    assert here.figures["light"] == "none"
    assert "light_error_none" not in here.figures


class StoppedError(Exception):
    pass


def test_a_stopped_lit_fit_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points, _ = case(lit=True)
    config = {
        "light": "camera", "iterations": 40, "densify": True, "densify_from_iter": 10,
        "densification_interval": 10, "max_gaussians": 3500, "densify_grad_threshold": 1e-7,
        "densify_abs_grad_threshold": 1e-7, "densify_until_iter": 40,
        "optimize_poses": True, "optimize_focal": True,
        "hold_surface": True, "hold_colors_until": 0.1, "preview_every": 15,
    }  # fmt: skip
    whole = context(tmp_path / "a", views, cameras, points, threads=1, **config)
    FitStage().run(whole)
    stopped = context(tmp_path / "b", views, cameras, points, checkpoint_every=7, **config)

    def stop(step, done, total, **figures):
        if step == "fit" and done >= 30:
            raise StoppedError

    stopped.on_progress = stop
    with pytest.raises(StoppedError):
        FitStage().run(stopped)
    again = context(tmp_path / "b", views, cameras, points, **config)
    FitStage().run(again)
    assert again.figures == whole.figures

    def files(folder) -> dict[str, bytes]:
        return {
            str(path.relative_to(folder)): path.read_bytes()
            for kind in ("gaussians", "cameras", "pictures")
            for path in sorted((folder / kind).rglob("*"))
        }

    assert files(tmp_path / "a") == files(tmp_path / "b")
    written = set(files(tmp_path / "a"))
    assert {"gaussians/light.safetensors", "pictures/curve.csv"} <= written
    assert {f"pictures/fit_{n:05d}.png" for n in (15, 30, 40)} <= written
    rows = (tmp_path / "a" / "pictures" / "curve.csv").read_text().splitlines()
    assert rows[0] == "iteration,loss,psnr,gaussians"
    assert [row.split(",")[0] for row in rows[1:]] == ["10", "20", "30", "40"]
    assert int(rows[-1].split(",")[3]) > 2500  # it did densify
