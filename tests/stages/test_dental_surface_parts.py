"""Parts of the dense surface of the teeth, against exact or slow and obvious answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.init.dental.landmarks import Landmark
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.chart.crown_shape import crown_points, crown_radius, jaw_shape
from stages.init.dental.surface.chart.grid import (
    AXIS_DEPTH,
    ChartGrid,
    faces_of,
    grid_around,
    normals_of,
    unroll,
)
from stages.init.dental.surface.chart.jaws import (
    SOLID_PAST_EDGE,
    Chart,
    nearest_depths,
    teeth_present,
)
from stages.init.dental.surface.chart.raster import raster_chart, sees
from stages.init.dental.surface.colour import (
    Showing,
    blend,
    even_rim,
    find_gains,
    find_tissue,
    hidden_edges,
    spread_colour,
)
from stages.init.dental.surface.fit import fit_offsets
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.tissue import without_fringes, without_small_holes
from stages.init.dental.surface.sweep import choose_pairs, matching_cost
from tests.stages.dental_surface_case import photo, row_of_teeth

GRID = ChartGrid(left=-20.0, top=5.0, density=4.0, shape=(41, 161))


def test_chart_of_a_cylinder() -> None:
    radius = np.full(GRID.shape, 30.0, np.float32)
    points = GRID.points(radius)
    arc, distance = unroll(points)
    np.testing.assert_allclose(distance, 30, rtol=1e-6)
    np.testing.assert_allclose(arc, np.broadcast_to(GRID.arcs, GRID.shape), atol=1e-4)
    outward = points - [0, 0, -AXIS_DEPTH]
    outward[..., 1] = 0
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    np.testing.assert_allclose(normals_of(points)[1:-1, 1:-1], outward[1:-1, 1:-1], atol=1e-3)


def test_faces_are_counter_clockwise_from_outside() -> None:
    used = np.ones(GRID.shape, bool)
    used[10, 20] = False
    points = GRID.points(np.full(GRID.shape, 30.0, np.float32)).reshape(-1, 3)
    faces = faces_of(used)
    assert len(faces) == 2 * 40 * 160 - 6
    assert 10 * 161 + 20 not in faces
    a, b, c = (points[faces[:, k]].astype(float) for k in range(3))
    normal = np.cross(b - a, c - a)
    assert ((normal * (a - [0, 0, -AXIS_DEPTH]))[:, [0, 2]].sum(axis=1) > 0).all()


def test_moved_samples_are_found_again() -> None:
    arcs, heights = np.meshgrid(GRID.arcs, GRID.heights)
    wavy = (30 + 0.8 * np.sin(arcs / 3) * np.cos(heights / 2)).astype(np.float32)
    points = GRID.points(wavy)
    # The same surface, its samples moved along it: the chart must stay as it is.
    shifted = ChartGrid(GRID.left + 0.4, GRID.top - 0.3, GRID.density, GRID.shape)
    arcs, heights = np.meshgrid(shifted.arcs, shifted.heights)
    moved = shifted.points((30 + 0.8 * np.sin(arcs / 3) * np.cos(heights / 2)).astype(np.float32))
    again = GRID.radius_of(moved)
    assert np.abs(moved - points).max() > 0.3
    assert np.abs(again - wavy)[3:-3, 3:-3].max() < 0.02


def test_grid_holds_its_points() -> None:
    points = np.array([[-25.0, 3, -30], [0, -4, 2], [20, 8, -10]])
    grid = grid_around(points, 1.0, 8.0)
    arc, _ = unroll(points)
    assert grid.arcs[0] <= arc.min() - 0.9 and grid.arcs[-1] >= arc.max() + 0.8
    assert grid.heights[0] >= 8.9 and grid.heights[-1] <= -4.8
    finer = grid.resized(16.0)
    np.testing.assert_allclose(finer.arcs[-1], grid.arcs[-1], atol=0.13)
    values = np.random.default_rng(0).normal(size=grid.shape).astype(np.float32)
    np.testing.assert_allclose(
        grid.resample(values, finer)[::2, ::2][: grid.shape[0], : grid.shape[1]],
        values[: (finer.shape[0] + 1) // 2, : (finer.shape[1] + 1) // 2],
        atol=1e-2,
    )


def test_crowns_bulge_between_their_landmarks() -> None:
    marks = row_of_teeth()
    shape = jaw_shape("upper", marks, {13, 12, 11, 21, 22, 23}, set())
    assert shape is not None
    points = crown_points(shape, bulge=0.8, flatness=2.6)
    grid = grid_around(points, 1.0, 4.0)
    radius = crown_radius(grid, points, 0.3)

    def at(angle: float, y: float) -> float:
        column = int(np.argmin(np.abs(grid.arcs - angle * 30)))
        return float(radius[int(np.argmin(np.abs(grid.heights - y))), column])

    middle = 0.135  # tooth 21
    assert at(middle, 5.5) == pytest.approx(26.8, abs=0.25)
    assert at(middle, 0.3) == pytest.approx(26.0, abs=0.4)
    assert at(0.0, 3) < at(middle, 3) - 1.0  # between 11 and 21
    # A symmetrical row gives a symmetrical surface.
    assert at(-middle, 5.5) == pytest.approx(at(middle, 5.5), abs=0.05)


def test_a_missing_tooth_leaves_no_crown() -> None:
    marks = row_of_teeth()
    order = (13, 12, 11, 22, 23)  # as labelled in a photograph without 21
    view = PlacedView(np.eye(4), 100.0, "frontal", order, (), 0.0)
    fit = ArchFit((view, None), marks, marks, 50.0)
    seen, missing = teeth_present(fit)
    assert seen == set(order)
    assert missing == {21}
    shape = jaw_shape("upper", marks, seen, missing)
    assert shape is not None
    assert 21 not in shape.teeth
    points = crown_points(shape, 0.8, 2.6)
    arc, radius = unroll(points)
    # Nothing is set where it would be, but for the edges of its neighbours.
    assert not ((np.abs(arc - 0.135 * 30) < 2.5) & (radius > 26.3)).any()


def test_teeth_that_one_photograph_skips_but_another_shows_are_there() -> None:
    views = (
        PlacedView(np.eye(4), 100.0, "frontal", (13, 11, 21), (), 0.0),
        PlacedView(np.eye(4), 100.0, "right", (14, 13, 12, 11), (), 0.0),
        PlacedView(np.eye(4), 100.0, "left", (21, 0, 23), (), 0.0),
    )
    seen, missing = teeth_present(ArchFit(views, {}, {}, 50.0))
    assert seen == {14, 13, 12, 11, 21, 23}
    # 22 may be what the unnamed crown between 21 and 23 is.
    assert missing == set()


def test_raster_of_a_cylinder_has_exact_depth() -> None:
    view = photo()
    points = GRID.points(np.full(GRID.shape, 30.0, np.float32))
    depth, place = raster_chart(view, points, np.ones(GRID.shape, bool))
    y, x = np.nonzero(depth)
    assert len(y) > 500
    a = (x + 0.5 - 50) / 150.0
    # |origin + t ray - axis| = 30 in the horizontal plane, camera 100 in front of the world origin.
    along = 100 + AXIS_DEPTH
    root = along**2 - (1 + a**2) * (along**2 - 900)
    truth = (along - np.sqrt(root)) / (1 + a**2)
    np.testing.assert_allclose(depth[y, x], truth, atol=0.02)
    angle = np.arctan2(a * truth, along - truth)
    np.testing.assert_allclose(place[y, x, 0], (angle * 30 - GRID.left) * GRID.density, atol=0.1)


def test_surfaces_are_not_painted_from_behind() -> None:
    behind = photo(yaw=180.0)
    points = GRID.points(np.full(GRID.shape, 30.0, np.float32))
    assert not raster_chart(behind, points, np.ones(GRID.shape, bool))[0].any()


def test_hidden_points_are_not_seen() -> None:
    view = photo()
    front = np.full(view.size, 90.0, np.float32)
    points = np.array([[[0, 0, 10.5], [0, 0, 9.5], [0, 0, 5.0], [500, 0, 20]]], np.float32)
    np.testing.assert_array_equal(sees(view, front, points, 1.0)[0], [True, True, False, False])
    assert sees(view, np.zeros_like(front), points, 1.0)[0, 2]


def test_a_jaw_hides_nothing_where_the_photograph_shows_the_other() -> None:
    """The upper chart goes on below its edges: what is seen there lies on the lower crowns."""
    upper = row_of_teeth()
    lower = {}
    for mark, place in upper.items():
        tooth, neighbour = (
            t and (t + 30 if t < 20 else t + 10) for t in (mark.tooth, mark.neighbour)
        )
        lower[Landmark(mark.kind, tooth, neighbour)] = place * [1, -1, 1] + [0, 3.0, -5.0]
    charts = []
    for jaw, marks in (("upper", upper), ("lower", lower)):
        shape = jaw_shape(jaw, marks, {mark.tooth for mark in marks}, set())
        assert shape is not None
        points = crown_points(shape, 0.8, 2.6)
        grid = grid_around(points, 1.0, 4.0)
        radius = crown_radius(grid, points, 0.3)
        charts.append(Chart(shape, grid, radius, np.zeros(grid.shape, np.float32)))
    view = photo()
    teeth = np.zeros(view.size, np.float32)
    teeth[:28] = 1  # less than the upper chart: its crowns' edges come to half the height
    alone = [
        raster_chart(view, chart.points, chart.used(SOLID_PAST_EDGE, 1.0))[0] for chart in charts
    ]
    both = (alone[0] > 0) & (alone[1] > 0)
    (front,) = nearest_depths(charts, [view], 1.0, 1)
    np.testing.assert_array_equal(front[both], alone[0][both])

    view = replace(view, upper=teeth, lower=1 - teeth)
    (front,) = nearest_depths(charts, [view], 1.0, 1)
    above, below = both & (teeth > 0), both & (teeth == 0)
    assert above.sum() > 100 and below.sum() > 10
    np.testing.assert_array_equal(front[above], alone[0][above])
    np.testing.assert_array_equal(front[below], alone[1][below])
    assert (alone[1][below] - alone[0][below]).min() > 2, "behind by the overjet"


def test_matching_cost_is_one_minus_correlation() -> None:
    photos = [photo(-20, seed=1), photo(20, seed=2)]
    points = GRID.points(np.full(GRID.shape, 30.0, np.float32))
    normals = normals_of(points)
    offsets = np.array([-0.5, 0, 0.5], np.float32)
    seen = np.ones((2, *GRID.shape), bool)
    seen[1, :, :30] = False
    cost = matching_cost(points, normals, offsets, photos, seen, [[0, 1]], 3)
    assert cost.shape == (*GRID.shape, 3)
    for row, col, plane in ((20, 80, 0), (12, 100, 1), (25, 70, 2)):
        window = (slice(row - 3, row + 4), slice(col - 3, col + 4))
        moved = points[window] + offsets[plane] * normals[window]
        a, b = (p.sample(p.texture, p.project(moved)[0]).ravel() for p in photos)
        expected = 1 - np.corrcoef(a, b)[0, 1]
        assert cost[row, col, plane] == pytest.approx(np.clip(expected, 0, 1.4), abs=0.03)
    # Where one of them sees nothing the cost says nothing.
    assert len(np.unique(cost[:, :30])) == 1


def test_pairs_are_neighbours_of_a_useful_angle() -> None:
    photos = [photo(yaw) for yaw in (40.0, -45.0, 0.0, 4.0)]
    middle = np.array([0.0, 0, 0])
    assert choose_pairs(photos, middle, SurfaceOptions()) == [[0, 2], [0, 3], [1, 2]]
    far = [photo(-60.0), photo(60.0)]
    assert choose_pairs(far, middle, SurfaceOptions()) == []


def test_offsets_fit_is_the_thin_plate_and_robust() -> None:
    rng = np.random.default_rng(3)
    rows, cols = np.mgrid[:64, :120]
    truth = (0.6 * np.sin(cols / 25) + 0.01 * rows).astype(np.float32)
    found = (truth + 0.05 * rng.normal(size=truth.shape)).astype(np.float32)
    wrong = rng.random(truth.shape) < 0.15
    found[wrong] += 3.0
    weight = np.ones(truth.shape, np.float32)
    fitted = fit_offsets(found, weight, stiffness=5.0, anchor=1e-4, outlier=0.3)
    assert np.abs(fitted - truth)[6:-6, 6:-6].mean() < 0.12
    # A plane costs no bending and is reproduced; without evidence the field falls back to 0.
    plane = (0.02 * cols - 0.01 * rows).astype(np.float32)
    fitted = fit_offsets(plane, weight, stiffness=50.0, anchor=1e-6, outlier=5.0)
    np.testing.assert_allclose(fitted[4:-4, 4:-4], plane[4:-4, 4:-4], atol=0.03)
    nothing = fit_offsets(found, np.zeros_like(weight), 5.0, 0.02, 0.6)
    np.testing.assert_array_equal(nothing, 0)


def test_highlights_and_shade_between_crowns_are_no_holes() -> None:
    mask = np.zeros((200, 300), bool)
    mask[:150, 20:280] = True  # gum and teeth, up to the upper border of the photograph
    expected = mask.copy()
    mask[40:60, 60:80] = False  # 25 square mm at four pixels a mm
    mask[100:103, 100:150] = mask[143:150, 200:206] = False  # a seam; a narrow notch
    for hole in (np.s_[30:60, 120:160], np.s_[0:30, 200:230], np.s_[110:150, 250:280]):
        mask[hole] = expected[hole] = False  # large; at the border; open to the outside
    filled = without_small_holes(mask, 4.0)
    assert filled[40:60, 60:80].all() and filled[100:103, 100:150].all()
    assert (filled != expected).mean() < 0.002  # but for corners


def test_a_rim_has_no_fringes_and_no_slits() -> None:
    expected = np.zeros((200, 300), bool)
    expected[:100] = True  # at four samples per mm
    ragged = expected.copy()
    ragged[100:120, 30:34] = ragged[100:120, 280:283] = True
    ragged[60:100, 150:155] = False
    even = without_fringes(ragged, 4.0)
    assert (ragged != expected).sum() > 300
    assert (even != expected).sum() < 50  # but for corners
    np.testing.assert_array_equal(without_fringes(expected, 4.0), expected)
    assert not without_fringes(np.zeros_like(expected), 4.0).any()


def test_gains_undo_exposures() -> None:
    rng = np.random.default_rng(1)
    true = rng.uniform(0.3, 0.6, (40, 50, 3))
    exposure = np.array([[0.8, 0.9, 1.0], [1, 1, 1], [1.2, 1.1, 1.3], [0.7, 0.7, 0.7]])
    colours = [[(true * e).astype(np.float32) for e in exposure]]
    weights = [np.zeros((40, 50), np.float32) for _ in exposure]
    weights[0][:, :20] = weights[1][:, 10:35] = weights[2][:, 25:] = 1
    gains = find_gains(colours, [weights], anchor=1)
    np.testing.assert_allclose(gains[:3] * exposure[:3], 1, rtol=0.01)
    # Nothing in common with the others: left as it is.
    np.testing.assert_allclose(gains[3], 1)


def test_colour_spreads_to_the_nearest() -> None:
    colour = np.zeros((5, 9, 3), np.float32)
    colour[:, 0], colour[:, 8] = [1, 0, 0], [0, 0, 1]
    known = np.zeros((5, 9), bool)
    known[:, [0, 8]] = True
    spread = spread_colour(colour, known)
    np.testing.assert_array_equal(spread[:, :4], np.broadcast_to([1, 0, 0], (5, 4, 3)))
    np.testing.assert_array_equal(spread[:, 5:], np.broadcast_to([0, 0, 1], (5, 4, 3)))


def test_rim_of_the_gum_is_even_and_teeth_are_never_cut() -> None:
    density = 8.0
    rows, cols = 120, 240
    beyond = np.broadcast_to((60 - np.arange(rows))[:, None] / density, (rows, cols))
    beyond = beyond.astype(np.float32)
    tooth = np.zeros((rows, cols), bool)
    tooth[50:100] = True
    kept = tooth.copy()
    kept[20:] = True
    kept[:20, 100:110] = True  # a spike
    kept[:34, 150:] = False  # a step
    even = even_rim(kept, tooth, beyond, density)
    assert even[tooth].all()
    assert not (even & ~kept).any()
    top = even.argmax(axis=0)
    assert abs(int(top[105]) - int(top[60])) <= 1
    assert np.abs(np.diff(top[20:-20])).max() <= 2
    assert top[60] == 20 and top[200] == 34


def test_crumbs_and_what_is_seen_drawn_out_are_no_tissue() -> None:
    density, size = 8.0, (200, 400)
    tooth = np.zeros(size, np.float32)
    tooth[40:160, 20:180] = 1  # 15 x 20 mm
    tooth[80:96, 220:260] = 1  # 2 x 5
    tooth[80:112, 300:340] = 1  # 4 x 5

    def tissue(cosine: float) -> np.ndarray:
        nothing, all_of_it = np.zeros(size, np.float32), np.ones(size, np.float32)
        shown = Showing(
            seen=np.ones(size, bool), facing=np.full(size, cosine, np.float32), tooth=tooth,
            gum=nothing, colour=np.zeros((*size, 3), np.float32), dull=all_of_it,
        )  # fmt: skip
        return find_tissue([shown], density, 0.35, SurfaceOptions().least_showing)[0]

    kept = tissue(0.4)
    assert kept[100, 100] and kept[96, 320]
    assert not kept[80:96, 220:260].any()
    assert not tissue(0.3).any()


def test_hidden_edges_go_on_a_little_and_only_on_crowns() -> None:
    tooth = np.zeros((60, 40), bool)
    tooth[:20, 5:35] = True
    crowns = np.zeros_like(tooth)
    crowns[:50, :20] = True
    hidden = hidden_edges(tooth, crowns, density=10.0, length=1.2)
    assert hidden[20:31, 10].all()
    assert not hidden[34:].any()
    assert not hidden[:, 20:].any()
    assert not (hidden & tooth).any()


def test_under_a_highlight_lies_the_shade_around_it() -> None:
    """Of the photograph itself: the other one, darker, only lends what is under the light."""
    density = 10.0
    y, x = np.mgrid[:120, :160]
    lit = (x - 80) ** 2 + (y - 60) ** 2 < 8**2
    stripes = np.where((x // 3) % 2, 0.02, -0.02).astype(np.float32)
    front, side = 0.8 + stripes, 0.4 + stripes
    front[lit] = 1.0
    colours = [np.repeat(c[..., None], 3, 2).astype(np.float32) for c in (front, side)]
    weights = [np.where(lit, 0.001, 1.0), np.full(lit.shape, 0.05)]
    mixed, total = blend(colours, [w.astype(np.float32) for w in weights], np.ones((2, 3)), density)
    assert abs(mixed[lit].mean() - mixed[~lit].mean()) < 0.03
    assert mixed[lit].std() == pytest.approx(0.02, abs=0.01)
    assert total[60, 80] == pytest.approx(0.051)


def test_one_photograph_alone_keeps_its_colours() -> None:
    rng = np.random.default_rng(0)
    colour = rng.uniform(0.2, 0.8, (50, 90, 3)).astype(np.float32)
    shown = np.ones((50, 90), np.float32)
    mixed, _ = blend([colour, 0 * colour], [shown, 0 * shown], np.ones((2, 3)), 8.0)
    np.testing.assert_allclose(mixed, colour, atol=1e-5)
