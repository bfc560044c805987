"""Cheek beside the last tooth, as red as gum, is not taken for gum."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from stages.init.dental.surface.chart.crown_shape import crown_points, crown_radius, jaw_shape
from stages.init.dental.surface.chart.grid import grid_around
from stages.init.dental.surface.chart.jaws import Chart, _scraps, comparable, nearest_depths
from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.ends import _with_hidden_fronts
from stages.init.dental.surface.options import SurfaceOptions
from tests.stages.dental_arch_scene import (
    AXIS,
    CROWN_ANGLE,
    FOCAL,
    GUM,
    HEIGHT,
    TEETH,
    WIDTH,
    outline,
    scene,
)
from tests.stages.dental_surface_case import photo, row_of_teeth

#: Where the patient's last upper tooth on the right begins: four to either side.
END = -3 * CROWN_ANGLE
PAST = SurfaceOptions().past_row


def angles(depth: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """[H, W] about the arches' axis of what a camera sees."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1)
    points = (ray * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
    return np.arctan2(points[..., 0], points[..., 2] + AXIS)


@functools.cache
def with_cheek():  # type: ignore[no-untyped-def]
    """The scene, where cheek hides the last upper tooth on the right, and its gum."""
    images, valid, dentitions, fit, truth = scene(missing=TEETH["upper"][0])
    painted, read, cheeks = [], [], []
    for image, dentition, view, (depth, jaw, kind) in zip(
        images, dentitions, fit.views, truth, strict=True
    ):
        cheek = (jaw == 1) & (angles(depth, view.cam_from_world) < END)
        picture = image.copy()
        picture[cheek] = GUM
        first, *rest = dentition.upper
        whole = replace(first, outline=outline((kind == 2) & (jaw == 1) & ~cheek))
        painted.append(picture)
        read.append(replace(dentition, upper=(whole, *rest)))
        cheeks.append(cheek)
    return painted, valid, read, fit, truth, cheeks


@functools.cache
def surface(past_row: float | None) -> ArchSurface:
    options = SurfaceOptions(rounds=(), past_row=past_row)
    return dense_surface(*with_cheek()[:4], options=options, threads=2)


def test_what_is_red_beyond_the_last_tooth_is_no_gum() -> None:
    *_, truth, cheeks = with_cheek()
    depth, radius = truth[0][0], 24.0
    angle = angles(depth, with_cheek()[3].views[0].cam_from_world)
    beyond = cheeks[0] & (angle < END - (PAST + 0.5) / radius)
    assert beyond.sum() > 100
    assert (surface(None).views[0].depth > 0)[beyond].mean() > 0.5  # else nothing would be tested
    assert (surface(PAST).views[0].depth > 0)[beyond].mean() < 0.05


def test_all_else_stays() -> None:
    for cheek, cut, whole in zip(
        with_cheek()[5], surface(PAST).views, surface(None).views, strict=True
    ):
        before = (whole.depth > 0) & ~cheek
        assert (cut.depth > 0)[before].mean() > 0.98


@pytest.mark.parametrize(
    ("rows", "spans"),
    [
        # a deep bite hides the lower front teeth in a photograph from the right
        ([(-45.0, 12.0), (-40.0, -25.0)], [(-45.0, 12.0), (-40.0, 12.0)]),
        # and all of the lower jaw's
        ([(-30.0, 30.0), None], [(-30.0, 30.0), (-20.0, 20.0)]),
        ([(-45.0, 40.0), (-38.0, 44.0)], [(-45.0, 40.0), (-38.0, 44.0)]),
    ],
)
def test_among_front_teeth_the_other_jaw_tells_as_well(
    rows: list[tuple[float, float] | None], spans: list[tuple[float, float]]
) -> None:
    assert _with_hidden_fronts(rows) == spans


@pytest.mark.parametrize("only_clear", [True, False])
def test_what_all_photographs_see_at_a_low_angle_is_no_surface(only_clear: bool) -> None:
    """One photograph, from the right: the arch turns away from it on the left."""
    images, valid, dentitions, fit, truth = scene()
    view = fit.views[0]
    alone = replace(fit, views=(view, None, None))
    options = SurfaceOptions(rounds=(), only_clear=only_clear)
    surface = dense_surface(images, valid, dentitions, alone, options)
    shown = surface.views[0].depth > 0
    depth, _, kind = truth[0]
    angle = angles(depth, view.cam_from_world)
    away, towards = (kind == 2) & (angle > 0.6), (kind == 2) & (angle < 0.2)
    assert away.sum() > 50
    assert shown[towards].mean() > 0.95
    assert shown[away].mean() < 0.15 if only_clear else shown[away].mean() > 0.5
    # nor does the cloud go on where the photograph has no depth
    x, _, z = surface.positions[surface.tooth].T
    beyond = np.mean(np.arctan2(x, z + AXIS) > 0.6)
    assert beyond == 0 if only_clear else beyond > 0.02


def test_what_a_better_facing_photograph_does_not_show_needs_a_good_angle() -> None:
    """The last crown on the right, drawn out in the frontal photograph: is it seen from the right?

    The arch turns to 60 degrees from the frontal line of sight within it.
    """
    images, valid, dentitions, fit, truth = scene()
    ends = angles(truth[0][0], fit.views[0].cam_from_world) < END
    cut = [valid[0] & ~ends, *valid[1:]]
    options = SurfaceOptions(rounds=())
    whole, short = (
        dense_surface(images, usable, dentitions, fit, options).views[1].depth > 0
        for usable in (valid, cut)
    )
    depth, _, kind = truth[1]
    angle = angles(depth, fit.views[1].cam_from_world)
    drawn_out, clear = (kind == 2) & (angle < -1.0), (kind == 2) & (angle > -0.9)
    assert drawn_out.sum() > 20
    assert whole[drawn_out].mean() > 0.95
    assert short[drawn_out].mean() < 0.2
    assert short[clear].mean() > 0.98


def test_a_scrap_smaller_than_a_tooth_and_its_gum_is_none_of_the_surface() -> None:
    """The largest piece stays, however small, and so does another with room for a tooth."""
    row, tooth, scrap = (np.zeros((60, 400), bool) for _ in range(3))
    row[10:50, 10:200] = True
    tooth[10:50, 250:280] = True  # 20 x 15 mm at two samples per mm
    scrap[10:30, 300:316] = True  # 10 x 8 mm
    np.testing.assert_array_equal(_scraps(row | tooth | scrap, 2.0), scrap)
    assert not _scraps(scrap, 2.0).any()
    assert not _scraps(np.zeros_like(row), 2.0).any()


def test_what_is_compared_lies_within_its_own_jaw() -> None:
    """Windows that reach over the biting edges would see what is behind them."""
    marks = row_of_teeth()
    shape = jaw_shape("upper", marks, {mark.tooth for mark in marks}, set())
    assert shape is not None
    points = crown_points(shape, 0.8, 2.6)
    grid = grid_around(points, 1.0, 4.0)
    chart = Chart(shape, grid, crown_radius(grid, points, 0.3), np.zeros(grid.shape, np.float32))
    view = photo()
    teeth = np.zeros(view.size, np.float32)
    teeth[:25] = 1
    view = replace(view, upper=teeth, lower=1 - teeth)
    options = SurfaceOptions()
    front = nearest_depths([chart], [view], options.gum_height, 1)
    _, rows = np.moveaxis(view.project(chart.points)[0], -1, 0)
    (within,) = comparable(chart, [view], front, options, 2.0)
    (about,) = comparable(chart, [view], front, options, -0.5)
    assert within.sum() > 300
    assert rows[within].max() < 25 - 2.0 * view.density + 1
    assert rows[about].max() > 25
    assert about[within].all()
