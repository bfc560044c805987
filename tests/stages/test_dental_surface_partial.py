"""A crown that a lip cuts off in one photograph, and another photograph shows whole."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import numpy.typing as npt
import pytest

from stages.init.dental.surface.chart.crown_shape import (
    JawShape,
    crown_points,
    crown_radius,
    jaw_shape,
    tooth_of_columns,
    within_crowns,
)
from stages.init.dental.surface.chart.grid import MEAN_RADIUS, ChartGrid, grid_around
from stages.init.dental.surface.chart.jaws import (
    FACING_SMOOTHING,
    Chart,
    facing,
    nearest_depths,
    smooth_normals,
)
from stages.init.dental.surface.chart.partial import partial_crowns
from stages.init.dental.surface.chart.raster import raster_chart
from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from tests.stages.dental_arch_scene import outline, pieces, scene
from tests.stages.dental_surface_case import photo, row_of_teeth

UPPER, GUM, TOOTH = 1, 1, 2
#: Columns of the photographs: 21 of the one from the right is 118 to 136 wide, of that from the
#: front 101 to 127; a lip begins in the middle of it.
FAR_21, LIP, FRONT_21 = (119, 126), 127, (102, 126)
SKIN = np.array([0.6, 0.4, 0.3], np.float32)


@functools.cache
def plain():  # type: ignore[no-untyped-def]
    return scene()


def with_lips(edges: tuple[int | None, ...]):  # type: ignore[no-untyped-def]
    """In each photograph skin from a column on before the upper jaw; None: nowhere."""
    images, valid, dentitions, fit, truth = plain()
    images, dentitions = list(images), list(dentitions)
    for k, edge in enumerate(edges):
        if edge is None:
            continue
        _, jaw, kind = truth[k]
        x = np.broadcast_to(np.arange(kind.shape[1]), kind.shape)
        lip = (jaw == UPPER) & (x > edge) & (kind > 0)
        images[k] = np.where(lip[..., None], SKIN, images[k])
        first, *rest = dentitions[k].upper
        crown = dataclasses.replace(first, outline=outline((jaw == UPPER) & (kind == TOOTH) & ~lip))
        on_jaws = pieces(((kind == GUM) | (kind == TOOTH)) & ~lip)
        dentitions[k] = dataclasses.replace(dentitions[k], upper=(crown, *rest), on_jaws=on_jaws)
    return images, valid, dentitions, fit


@functools.cache
def surface(edges: tuple[int | None, ...], exact: bool = False) -> ArchSurface:
    options = SurfaceOptions(rounds=(), only_clear=not exact)  # the crown shapes are near enough
    return dense_surface(*with_lips(edges), options=options, threads=2)


def crown(photo: int, columns: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """[H, W] bool: upper teeth between two columns of a photograph."""
    _, jaw, kind = plain()[4][photo]
    x = np.broadcast_to(np.arange(kind.shape[1]), kind.shape)
    return (jaw == UPPER) & (kind == TOOTH) & (x >= columns[0]) & (x < columns[1])


def shown(result: ArchSurface, photo: int, columns: tuple[int, int]) -> float:
    view = result.views[photo]
    assert view is not None
    return float((view.depth > 0)[crown(photo, columns)].mean())


def test_what_is_left_of_the_crown_is_left_to_the_photograph_that_shows_it_whole() -> None:
    cut = surface((LIP, None, None))
    assert shown(surface((None, None, None)), 0, FAR_21) > 0.95
    assert shown(cut, 0, FAR_21) < 0.05
    assert shown(cut, 1, FRONT_21) > 0.95


def test_its_neighbour_and_the_other_photographs_lose_nothing() -> None:
    cut, whole = surface((LIP, None, None)), surface((None, None, None))
    assert shown(cut, 0, (60, 115)) > 0.97
    for after, before in zip(cut.views[1:], whole.views[1:], strict=True):
        assert after is not None and before is not None
        assert (after.depth > 0)[before.depth > 0].mean() > 0.99


def test_where_no_photograph_shows_it_whole_it_stays() -> None:
    """A lip begins in the middle of it in all three."""
    assert shown(surface((LIP, 114, 91)), 0, FAR_21) > 0.95


def test_with_exact_cameras_it_stays() -> None:
    """There the light alone differs."""
    assert shown(surface((LIP, None, None), exact=True), 0, FAR_21) > 0.95


def test_a_flank_is_left_to_the_photograph_that_it_is_turned_to() -> None:
    """One from the left, in which a lip covers most of 11."""
    shape = jaw_shape("upper", row_of_teeth(), {13, 12, 11, 21, 22, 23}, set())
    assert shape is not None
    points = crown_points(shape, 2.0, 2.0)
    grid = grid_around(points, 2.0, 5.0)
    radius = crown_radius(grid, points, 0.3)
    chart = Chart(shape, grid, radius, np.zeros(grid.shape, np.float32))
    front, side = (photo(yaw, size=(300, 500), focal=700.0) for yaw in (0.0, 35.0))
    columns = tooth_of_columns(grid, shape)
    lip = float(np.quantile(grid.arcs[columns == 11], 0.7))
    photos = []
    for each, covered in ((front, False), (side, True)):
        depth, place = raster_chart(each, chart.points, within_crowns(grid, shape))
        arcs = grid.left + place[..., 0] / grid.density
        crowns = (depth > 0) & ~(covered & (arcs < lip))
        photos.append(dataclasses.replace(each, upper=crowns.astype(np.float32)))
    nearest = nearest_depths([chart], photos, 4.0, 1)
    options = SurfaceOptions()
    left_out = partial_crowns(chart, photos, nearest, options, 1)
    assert not left_out[0].any()
    (cut,) = set(columns[left_out[1].any(axis=0)]) - {13, 12}
    assert cut == 11
    normals = smooth_normals(chart.radius, grid, FACING_SMOOTHING)
    turned = [facing(each, chart.points, normals) for each in photos]
    crown = within_crowns(grid, shape) & (columns == 11)[None] & (photo_shows(photos[0], chart))
    assert left_out[1][crown & (turned[0] > turned[1] + 0.05)].mean() > 0.95
    flank = crown & (turned[1] > turned[0] + 0.05)
    assert flank.sum() > 20 and not left_out[1][flank].any()


def photo_shows(view: Photo, chart: Chart) -> npt.NDArray[np.bool_]:
    """[H, W] bool: samples that lie within a crown in a photograph."""
    return view.sample(view.upper, view.project(chart.points)[0]) > 0.5


def test_columns_belong_to_the_tooth_between_its_boundaries() -> None:
    marks = row_of_teeth()
    teeth = (13, 12, 11, 21, 22, 23)
    grid = ChartGrid(-60.0, 12.0, 5.0, (70, 601))
    owner = tooth_of_columns(grid, JawShape("upper", teeth, marks))
    width = 0.27 * MEAN_RADIUS
    for k, tooth in enumerate(teeth):
        middle = (k - 2.5) * width
        for aside in (-0.45, 0.45):
            column = round((middle + aside * width - grid.left) * grid.density)
            assert owner[column] == tooth
    assert (owner > 0).sum() == pytest.approx(6 * width * grid.density, abs=2)
    assert owner[0] == owner[-1] == 0


def test_of_one_tooth_alone_all_columns_are_its_own() -> None:
    marks = {m: p for m, p in row_of_teeth().items() if m.tooth == 11 and not m.neighbour}
    owner = tooth_of_columns(
        ChartGrid(-20.0, 12.0, 5.0, (70, 201)), JawShape("upper", (11,), marks)
    )
    assert set(owner) == {11}
