"""The lining of a held surface: where it is, that it closes gaps, and that it resumes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.artifacts.views import Views
from stages.fit.config import FitConfig, resolve
from stages.fit.inputs.scene import prepare
from stages.fit.numerics.surface import inland, rim
from stages.fit.parts.surface import BEHIND, CLEAR, WIDTH, Surface
from stages.fit.stage import FitStage
from stages.splatting.rendering import render
from tests.stages.fit_case import run_until
from tests.stages.lit_fit_case import case, context

HELD = {"light": "none", "hold_surface": True}


def trainer(lit=False, **config):
    """Of three photographs, just before its first step."""
    views, cameras, points, _ = case(lit=False)
    few = views.views[:3]
    config = {**HELD, "initial_points": 2500, **config}
    settings = resolve(FitConfig(**config), 3, 0, True, few[0].image[..., 0].size)
    scene = prepare(few, cameras.cameras[:3], points, None, settings)
    return scene.trainer(settings, lit)


def test_it_is_behind_every_so_many_and_wider() -> None:
    fit = trainer(lining=0.25)
    bare = fit.packed.copy()
    number = len(bare)
    for part in fit.parts:
        part.begin(fit)
    lined, surface = fit.packed[number:], fit.find(Surface)
    assert np.array_equal(fit.packed[:number], bare) and 0.1 < len(lined) / number < 0.25
    # each is behind the Gaussian whose colours it has
    _, at = cKDTree(bare[:, 11:]).query(lined[:, 11:])
    source, normals = bare[at], surface.anchor[at, 3:6]
    width = np.exp(source[:, 7:10].max(1))
    move = lined[:, :3] - source[:, :3]
    np.testing.assert_allclose(move, -BEHIND * width[:, None] * normals, rtol=1e-3, atol=1e-6)
    for camera in fit.scene.cameras:
        further = [np.linalg.norm(rows[:, :3] - camera.centre, axis=1) for rows in (source, lined)]
        assert (further[1] > further[0]).all()
    grown = np.sort(lined[:, 7:10] - source[:, 7:10], axis=1)
    assert grown[:, 1:] == pytest.approx(np.log(2 * WIDTH), abs=1e-5)
    assert grown[:, 0] == pytest.approx(0)
    assert np.array_equal(lined[:, 10], source[:, 10])
    # and it is held there, not drawn back to the surface
    surface.follow(fit, None)
    np.testing.assert_allclose(fit.packed[number:, :3], lined[:, :3], atol=1e-5)


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] of a bent sheet of 50 x 30 with a hole of radius 5, unit normals; spacing about .7."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:30:0.7, 0:50:0.7].reshape(2, -1)
    x, y = (values + rng.uniform(-0.2, 0.2, len(values)) for values in (x, y))
    positions = np.stack([x, y, 0.01 * (x - 25) ** 2], 1)
    normals = np.stack([-0.02 * (x - 25), np.zeros_like(x), np.ones_like(x)], 1)
    solid = np.hypot(x - 25, y - 15) > 5
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return positions[solid], normals[solid]


def from_the_end(positions: np.ndarray) -> np.ndarray:
    """[N] how far points are from the sheet's edges and its hole, across."""
    x, y = positions[:, 0], positions[:, 1]
    edges = np.min([x, 49.7 - x, y, 29.4 - y], axis=0)
    return np.minimum(edges, np.hypot(x - 25, y - 15) - 5)


def test_where_a_surface_ends_is_found() -> None:
    positions, normals = sheet()
    found, away = rim(positions, normals), from_the_end(positions)
    assert found[away < 0.4].mean() > 0.9 and not found[away > 2.5].any()


def test_how_far_the_end_is() -> None:
    positions, normals = sheet()
    chosen, distance = inland(positions, normals, 3)
    assert np.array_equal(chosen, np.arange(len(positions))[::3])
    away = from_the_end(positions)[chosen]
    assert np.abs(distance - away)[away > 1].max() < 1.2
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(2000)
    z = np.linspace(-1, 1, 2000)
    ball = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    assert np.isinf(inland(ball, ball, 1)[1]).all()
    normals[::2] = 0  # half of them are no surface
    assert (inland(positions, normals, 1)[0] % 2).all()
    assert len(inland(positions[:20], normals[:20], 1)[0]) == 0


def test_it_never_gets_so_wide_that_it_is_seen_past_the_end() -> None:
    fit = trainer(lining=0.25)
    number, positions = len(fit.packed), fit.packed[:, :3].astype(float)
    for part in fit.parts:
        part.begin(fit)
    surface = fit.find(Surface)
    ends = positions[rim(positions, surface.anchor[:number, 3:6].astype(float))]
    _, at = cKDTree(fit.packed[:number, 11:]).query(fit.packed[number:, 11:])
    distance, _ = cKDTree(ends).query(positions[at])
    for _ in range(3):
        fit.packed[number:, 7:9] += 1.0
        surface.follow(fit, None)
    width = np.exp(fit.packed[number:, 7:10].max(1))
    assert (CLEAR * width < 1.01 * distance).all()
    assert width.max() > 1.5 * width.min()


def test_no_black_shows_from_nearer(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    few = Views(views=views.views[:3])
    darkest = {}
    for lining in (0.0, 0.25):
        here = context(tmp_path / str(lining), few, cameras, points, lining=lining, **HELD)
        FitStage().run(here)
        camera = cameras.cameras[1]
        near = camera.resized(3 * camera.width, 3 * camera.height)
        alpha = render(here.result("gaussians"), near).alpha
        middle = alpha[near.height // 4 : -near.height // 4, near.width // 4 : -near.width // 4]
        darkest[lining] = np.quantile(middle, 0.01)
    assert darkest[0.25] > 0.9 and 1 - darkest[0.25] < 0.4 * (1 - darkest[0.0])


def test_only_held_surfaces_without_a_light_have_it() -> None:
    assert "lining" in [part.name for part in trainer().parts]
    assert "lining" not in [part.name for part in trainer(lining=0.0).parts]
    assert "lining" not in [part.name for part in trainer(hold_surface=False, lining=0.5).parts]
    assert "lining" not in [part.name for part in trainer(lit=True).parts]


def test_a_stopped_fit_with_it_resumes_to_the_same_bytes(tmp_path) -> None:
    views, cameras, points, _ = case(lit=False)
    few = Views(views=views.views[:3])
    whole = context(tmp_path / "a", few, cameras, points, threads=1, iterations=30, **HELD)
    FitStage().run(whole)
    stopped = context(
        tmp_path / "b", few, cameras, points, checkpoint_every=4, iterations=30, **HELD
    )
    run_until(stopped, 20)
    again = context(tmp_path / "b", few, cameras, points, iterations=30, **HELD)
    FitStage().run(again)
    np.testing.assert_array_equal(whole.result("gaussians").means, again.result("gaussians").means)
