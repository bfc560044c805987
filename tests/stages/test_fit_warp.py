"""Bending a held surface as a whole: the field of splines, the turn, and what it does to a fit."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from stages.fit.numerics.spline_field import SplineField
from stages.fit.numerics.surface import Warp, turned
from stages.fit.stage import FitStage
from tests.stages.lit_fit_case import bump, case, context, lit_image

SPACING = 0.1


def points(count: int = 500) -> np.ndarray:
    return np.random.default_rng(4).uniform(-1, 1, (count, 3)) * [1.0, 0.7, 0.1]


def quadratic_spline(t: np.ndarray) -> np.ndarray:
    """The B-spline of degree 2 around 0, as textbooks have it."""
    t = np.abs(t)
    return np.where(t < 0.5, 0.75 - t**2, np.where(t < 1.5, 0.5 * (1.5 - t) ** 2, 0.0))


def test_every_level_can_be_constant() -> None:
    field = SplineField(points(), SPACING, 3)
    assert len(field.sizes) == 3 and field.sizes[0] > field.sizes[1] > field.sizes[2]
    start = 0
    for size in field.sizes:
        field.coefficients[:] = 0
        field.coefficients[start : start + size] = 2.5
        start += size
        value, slope = field.evaluate()
        assert value == pytest.approx(2.5, abs=1e-5) and np.abs(slope).max() < 1e-3


def test_a_coarse_spline_is_what_a_textbook_says() -> None:
    where = points()
    field = SplineField(where, SPACING, 2)
    fine, coarse = field.sizes
    # lattices are numbered in order of their cells: find which is which by where they are felt
    spacing = 2 * SPACING
    for number in (0, coarse // 2, coarse - 1):
        field.coefficients[:] = 0
        field.coefficients[fine + number] = 1
        value, _ = field.evaluate()
        middle = (where * value[:, None]).sum(0) / value.sum()
        cells = np.array([np.floor(middle / spacing) + step for step in np.ndindex(3, 3, 3)]) - 1
        textbook = [quadratic_spline(where / spacing - cell - 0.5).prod(axis=1) for cell in cells]
        assert min(np.abs(value - other).max() for other in textbook) < 1e-5


def test_slopes_are_those_of_the_values() -> None:
    where, step = points(), 1e-3
    count = len(where)
    for axis in range(3):
        moved = where.copy()
        moved[:, axis] += step
        both = SplineField(np.concatenate([where, moved]), SPACING, 3)
        both.coefficients[:] = np.random.default_rng(6).normal(size=len(both.coefficients))
        value, slope = both.evaluate()
        by_hand = (value[count:] - value[:count]) / step
        between = 0.5 * (slope[:count, axis] + slope[count:, axis])
        assert np.abs(by_hand).max() > 5
        assert between == pytest.approx(by_hand, rel=0.01, abs=0.05)


def test_gradients_are_gathered_as_values_are_spread_whatever_the_threads() -> None:
    field = SplineField(points(), SPACING, 3)
    rng = np.random.default_rng(7)
    field.coefficients[:] = rng.normal(size=len(field.coefficients))
    gradient = rng.normal(size=(500, 4)).astype(np.float32)
    value, slope = field.evaluate()
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = field.gather(gradient)
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(field.gather(gradient), alone)
    seen = np.concatenate([value[:, None], slope], 1).astype(np.float64)
    told = float((field.coefficients.astype(np.float64) * alone).sum())
    assert told == pytest.approx(float((seen * gradient).sum()), rel=1e-4)


def test_a_turn_takes_one_direction_to_another() -> None:
    rng = np.random.default_rng(8)
    first, second = rng.normal(size=(2, 50, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    second[0] = -first[0]
    none = np.tile(np.float32([1, 0, 0, 0]), (50, 1))
    q = turned(none, first.astype(np.float32), second.astype(np.float32)).astype(np.float64)
    w, u = q[:, :1], q[:, 1:]
    result = first + 2 * np.cross(u, np.cross(u, first) + w * first)
    assert result == pytest.approx(second, abs=1e-5)  # among them a half turn
    zero = np.zeros((50, 3), np.float32)
    assert np.array_equal(turned(none, zero, zero), none)
    assert np.array_equal(turned(none, none[:, :3], none[:, :3]), none)


def test_a_warp_moves_along_normals_once_all_views_have_spoken() -> None:
    where = points()
    normals = np.tile([0.0, 0, 1], (500, 1))
    normals[:100] = 0  # unknown
    warp = Warp(where, normals, SPACING, 2, 1.0, views=3)
    push = np.tile(np.float32([5, 5, -1]), (500, 1))  # a loss that falls towards +z
    for speaker in range(3):
        warp.collect(push, None)
        bent = warp.move(0.01)
        assert (bent is not None) == (speaker == 2)
    assert bent is not None
    assert (bent.move[100:, 2] > 0).all() and not bent.move[:, :2].any()
    assert not bent.move[:100].any() and not warp.facing[:100].any()
    assert np.abs(bent.lean[:, 2]).max() < 1e-6  # a change of direction, across the normal
    # and a pull at the normals tilts the surface under them
    warp = Warp(where, normals, SPACING, 2, 1.0, views=1)
    for _ in range(20):
        warp.collect(np.zeros_like(push), np.tile(np.float32([-1, 0, 0]), (500, 1)))
        warp.move(0.01)
    assert np.median(warp.facing[100:, 0]) > 0.3
    assert np.linalg.norm(warp.facing[100:], axis=1) == pytest.approx(1, abs=1e-5)


def test_a_warp_gets_no_steeper_than_it_may() -> None:
    where = points()
    normals = np.tile([0.0, 0, 1], (500, 1))
    warp = Warp(where, normals, SPACING, 3, 0.2, views=1)
    rng = np.random.default_rng(9)
    torn = rng.choice([-1, 1], (500, 1)) * np.float32([0, 0, 1])  # neighbours pull both ways
    for _ in range(300):
        warp.collect(torn, None)
        assert warp.move(0.01) is not None
    largest = np.abs(warp.field.coefficients)
    assert (largest <= 1.01 * warp.limits).all() and (largest > 0.9 * warp.limits).any()
    # three splines along each axis share a slope, on each of three levels
    assert np.abs(warp.shape[:, 1:]).max() < 3 * 2 * 0.2


def dented(count: int, depth: float) -> Points:
    """The sheet of `case`, pushed away from the cameras where its middle is."""
    sheet = bump(count, 2)
    x, y, _ = sheet.positions.T
    positions = sheet.positions.copy()
    positions[:, 2] += depth * np.exp(-(x**2 + y**2) / 20**2)
    return dataclasses.replace(sheet, positions=positions)


def test_photographs_bend_a_wrong_surface_back(tmp_path) -> None:
    _, cameras, _, plain = case(lit=True)
    assert plain.light is not None
    x, y, _ = plain.means.T
    pattern = [np.sin(x / 2) * np.cos(y / 2), np.sin((x + y) / 2.6), np.cos((x - y) / 2)]
    paint = (0.5 + 0.3 * np.stack(pattern, 1)).astype(np.float32)
    truth = dataclasses.replace(plain, light=dataclasses.replace(plain.light, albedo=paint))
    few = Cameras(cameras.cameras[::2])
    views = Views(tuple(View(c.name, lit_image(truth, c)) for c in few.cameras))
    start = dented(2500, 3.0)
    tree = cKDTree(truth.means)
    middle = {}
    for levels in (0, 3):
        here = context(
            tmp_path / str(levels), views, few, start, light="camera", hold_surface=True,
            iterations=300, warp_levels=levels, warp_spacing=0.04,
        )  # fmt: skip
        FitStage().run(here)
        assert (here.figures.get("surface_bent", 0) > 0.005) == (levels > 0)
        means = here.result("gaussians").means
        near = (np.abs(means[:, :2]) < 15).all(axis=1)
        middle[levels] = float(np.median(tree.query(means[near])[0]))
    assert middle[0] > 1.5
    assert middle[3] < 0.4 * middle[0]
