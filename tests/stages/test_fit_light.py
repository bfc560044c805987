"""The fit with a light beside the lens: recovery, choice, and the harmonics for other viewers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipeline.artifacts.views import View, Views
from stages.fit.stage import FitStage
from stages.splatting.rendering import render
from tests.stages.fit_case import run_until
from tests.stages.lit_fit_case import HEIGHT, WIDTH, case, context, lit_image, looking


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


@pytest.mark.parametrize(
    ("errors", "light"),
    [
        ((0.12, 0.05), "camera"),  # the scan video
        ((0.097, 0.067), "camera"),  # a generated mouth
        ((0.08, 0.06), "none"),  # hardly better with it
        ((0.129, 0.082), "none"),  # a patient's photographs, each with a flash of its own
    ],
)
def test_a_light_has_to_leave_little_unexplained(
    errors: tuple[float, float], light: str, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("stages.fit.lighting.prediction_errors", lambda *_: errors)
    views, cameras, points, _ = case(lit=True)
    few = Views(views=views.views[:3])
    here = context(tmp_path, few, cameras, points, light="auto", iterations=2, hold_surface=True)
    FitStage().run(here)
    assert here.figures["light"] == light


@pytest.mark.parametrize("own", [False, True])
def test_a_trial_tells_one_light_from_exposures_of_each_photograph(
    own: bool, tmp_path, monkeypatch
) -> None:
    """Both shade what they share about as well: .061 of .093 on three real photographs."""
    monkeypatch.setattr("stages.fit.lighting.prediction_errors", lambda *_: (0.093, 0.061))
    views, cameras, points, _ = case(lit=True, shine=0.1)
    gains = np.array([[1, 1, 1], [0.6, 0.7, 0.85], [1.3, 1.1, 1]], np.float32)
    few = Views(
        views=tuple(
            View(view.name, np.clip(view.image * (gain if own else 1), 0, 1))
            for view, gain in zip(views.views[::2], gains, strict=True)
        )
    )
    here = context(tmp_path, few, cameras, points, light="auto", iterations=2, hold_surface=True)
    FitStage().run(here)
    assert here.figures["light"] == ("none" if own else "camera")
    if own:
        assert here.figures["light_trial_camera"] < here.figures["light_trial_none"] - 2


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


def test_a_stopped_lit_fit_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points, _ = case(lit=True)
    config = {
        "light": "camera", "iterations": 40, "densify": True, "densify_from_iter": 10,
        "densification_interval": 10, "max_gaussians": 3500, "densify_grad_threshold": 1e-7,
        "densify_abs_grad_threshold": 1e-7, "densify_until_iter": 40,
        "optimize_poses": True, "optimize_focal": True,
        "hold_surface": True, "preview_every": 15,
    }  # fmt: skip
    whole = context(tmp_path / "a", views, cameras, points, threads=1, **config)
    FitStage().run(whole)
    stopped = context(tmp_path / "b", views, cameras, points, checkpoint_every=7, **config)
    run_until(stopped, 30)
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
