"""The colours that are solved for at the end of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.views import View, Views
from stages.fit.config import FitConfig, FitSettings, resolve
from stages.fit.inputs.scene import prepare
from stages.fit.numerics.colours import bounded, deviation, solved
from stages.fit.parts.camera import Exposure
from stages.fit.parts.colours import Colours, slope_of
from stages.fit.parts.light import Light
from stages.fit.stage import FitStage
from stages.fit.trainer import Trainer
from tests.stages import fit_case, lit_fit_case


def settings(**changes: object) -> FitSettings:
    wanted = {"iterations": 10, "initial_points": 1500, "optimize_poses": False, "densify": False}
    return resolve(FitConfig(**{**wanted, **changes}), 3, 0, None)


def trainer(lit: bool = False, **changes: object) -> Trainer:
    views, cameras, points = lit_fit_case.case(lit)[:3] if lit else fit_case.case()
    s = settings(light="camera" if lit else "none", **changes)
    made = prepare(views.views, cameras.cameras, points, None, s).trainer(s, lit)
    made.run(None, lambda *_: None)
    return made


def colours_of(fit: Trainer) -> Colours:
    part = fit.find(Colours)
    assert part is not None
    return part


def test_the_equations_are_solved_channel_by_channel() -> None:
    random = np.random.default_rng(0)
    rows = random.uniform(0, 1, (60, 12)) * (random.uniform(size=(60, 12)) < 0.3)
    matrix = rows.T @ rows
    wanted = random.normal(size=(12, 3)).astype(np.float32)
    found = solved(lambda x: (matrix @ x).astype(np.float32), wanted, 0.1, 40)
    np.testing.assert_allclose(found, np.linalg.solve(matrix + 0.1 * np.eye(12), wanted), atol=1e-4)
    assert not solved(lambda x: x, wanted, 0.1, 0).any()


def test_colours_stay_among_those_around() -> None:
    positions = np.arange(5, dtype=np.float32)[:, None] * np.array([[1, 0, 0]], np.float32)
    colours = np.array([0.2, 0.3, 0.4, 0.8, 0.9], np.float32)[:, None].repeat(3, 1)
    move = np.array([-1, 0.05, 1, -0.1, 1], np.float32)[:, None].repeat(3, 1)
    found = bounded(move, colours, positions, 2, 0.1)[:, 0]
    # each may go from 0.1 below to 0.1 above itself and its two nearest
    np.testing.assert_allclose(found, [-0.1, 0.05, 0.5, -0.1, 0.1], atol=1e-6)
    alone = bounded(move[:1], colours[:1], positions[:1], 2, 0.1)
    np.testing.assert_allclose(alone, -0.1, atol=1e-6)
    assert bounded(move[:0], colours[:0], positions[:0], 2, 0.1).shape == (0, 3)


def test_noise_is_told_from_the_few_pixels_that_differ_by_more() -> None:
    random = np.random.default_rng(2)
    images = [np.abs(random.normal(0, 0.04, (3, n))).astype(np.float32) for n in (900, 5000)]
    images[1][:, ::20] = 0.7
    assert deviation([image.ravel() for image in images]) == pytest.approx(0.04, rel=0.1)
    assert deviation([np.zeros(0, np.float32)]) == 0.0


def test_nothing_wanted_is_nothing_moved() -> None:
    nothing = np.zeros((4, 3), np.float32)
    assert not solved(lambda x: 2 * x, nothing, 0.1, 5).any()


@pytest.mark.parametrize("lit", [False, True])
def test_wrong_colours_come_right_and_nothing_else_moves(lit: bool) -> None:
    # spoilt like this, the photographs differ from it as if they were very noisy
    fit = trainer(lit, iterations=60, colour_steps=12, colour_spread=10)
    random = np.random.default_rng(1)
    before = fit.training_scores()[0].mean()
    shape = fit.packed[:, :11].copy()
    light = fit.find(Light)
    colours = fit.packed[:, 11:14] if light is None else light.material[:, :3]
    colours += random.normal(size=colours.shape).astype(np.float32) * (0.1 if lit else 0.4)
    spoilt = fit.training_scores()[0].mean()
    colours_of(fit).end(fit)
    after = fit.training_scores()[0].mean()
    assert spoilt < before - 3
    assert after > before
    np.testing.assert_array_equal(fit.packed[:, :11], shape)


def test_what_may_not_be_used_says_nothing() -> None:
    views, cameras, points = fit_case.case()
    mask = np.zeros((fit_case.HEIGHT, fit_case.WIDTH), bool)
    mask[:, : fit_case.WIDTH // 2] = True
    spoilt = [View(v.name, np.where(mask[..., None], v.image, 0.9), mask) for v in views.views]
    clean = [View(v.name, np.where(mask[..., None], v.image, 0.1), mask) for v in views.views]
    found = []
    for some in (spoilt, clean):
        s = settings(light="none")
        fit = prepare(Views(tuple(some)).views, cameras.cameras, points, None, s).trainer(s, False)
        colours_of(fit).end(fit)
        found.append(fit.packed)
    np.testing.assert_array_equal(*found)


def test_slopes_are_those_of_what_is_seen() -> None:
    fit = trainer(lit=True)
    light = fit.find(Light)
    assert light is not None
    light.material[:, :3] = np.clip(light.material[:, :3], 0.1, 0.9)
    viewpoint = fit.viewpoint(1, fit.targets[1][1])
    slope = slope_of(fit, 1)
    seen = []
    for change in (-0.01, 0.01):
        light.material[:, :3] += np.float32(change)
        light.shade(fit.packed, viewpoint)
        seen.append(fit.packed[:, 11:14] * 0.28209479177387814)
        light.material[:, :3] -= np.float32(change)
    np.testing.assert_allclose(slope, (seen[1] - seen[0]) / 0.02, rtol=0.02, atol=0.01)


def test_exposures_count() -> None:
    fit = trainer(exposure=True, iterations=40)
    assert not np.allclose(slope_of(fit, 0), slope_of(fit, 2), atol=1e-5)


def test_exposures_take_the_steps_of_their_own_photographs() -> None:
    views, cameras, points = fit_case.case()
    hidden = replace(views.views[1], mask=np.zeros((fit_case.HEIGHT, fit_case.WIDTH), bool))
    some = (views.views[0], hidden, views.views[2])
    s = settings(light="none", exposure=True, exposure_lr=0.01, iterations=2)
    fit = prepare(some, cameras.cameras, points, None, s).trainer(s, False)
    fit.run(None, lambda *_: None)
    exposure = fit.find(Exposure)
    assert exposure is not None and exposure.steps.tolist() == [1, 0, 1]


def test_exposures_that_the_scene_does_not_have_are_said(tmp_path) -> None:
    """The scene is evaluated as it is: 34 dB where the fit had 47."""
    views, cameras, points = fit_case.case()
    shown = [
        replace(v, image=v.image * np.float32(g))
        for v, g in zip(views.views, (0.6, 1, 0.9), strict=True)
    ]
    for exposure in (True, False):
        here = fit_case.context(
            tmp_path / str(exposure), Views(tuple(shown)), cameras, points, light="none",
            exposure=exposure, exposure_lr=0.02,
        )  # fmt: skip
        FitStage().run(here)
        assert ("exposure_gains" in here.figures) == exposure
        assert [text.partition("(")[2][:20] for text in here.warnings] == (
            [f"gains of {here.figures['exposure_gains']}"[:20]] if exposure else []
        )


def test_the_fit_says_that_it_did_and_can_do_without(tmp_path) -> None:
    views, cameras, points = fit_case.case()
    figures = {}
    for steps in (0, 4):
        here = fit_case.context(
            tmp_path / str(steps), views, cameras, points, light="none", colour_steps=steps
        )
        FitStage().run(here)
        figures[steps] = here.figures
    assert "colours" in figures[4]["parts"] and "colours" not in figures[0]["parts"]
    assert figures[4]["train_psnr"] > figures[0]["train_psnr"] + 0.2
