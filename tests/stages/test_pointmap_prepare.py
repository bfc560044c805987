"""Sizes that models want, the way back to the view's pixels, and the pairs that are asked for."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from stages.pointmaps.graph import choose_graph, scene_pairs
from stages.pointmaps.models.mapanything import SHAPES
from stages.pointmaps.prepare import (
    clean_map,
    fixed_width,
    multiple_of_patch,
    nearest_shape,
    padded_alike,
    prepare,
    resample_map,
)


def ramp(width: int, height: int) -> View:
    """A photograph that says where each of its pixels is: red across, green down, in 0..1."""
    image = np.full((height, width, 3), 0.5, np.float32)
    image[..., 0] = (np.arange(width) + 0.5) / width
    image[..., 1] = ((np.arange(height) + 0.5) / height)[:, None]
    return View("000", image)


@pytest.mark.parametrize(
    ("size", "long_side", "expected"),
    [
        ((1024, 768), 512, (512, 384)),
        ((640, 360), 512, (512, 288)),
        ((768, 1024), 512, (384, 512)),
        ((500, 500), 512, (512, 384)),
        ((4000, 3000), 224, (224, 224)),
        ((300, 200), 512, (512, 336)),
    ],
)
def test_sizes_of_the_dust3r_family(size, long_side, expected):
    framing = multiple_of_patch(*size, long_side)
    assert framing.crop[2:] == expected
    assert framing.crop[0] + expected[0] <= framing.resized[0]
    assert framing.crop[1] + expected[1] <= framing.resized[1]


def test_sizes_of_vggt_and_mapanything():
    assert fixed_width(512, 384).crop == (0, 0, 518, 392)
    assert fixed_width(384, 512).crop[2:] == (518, 518)
    assert nearest_shape(512, 384, 4 / 3, SHAPES).crop[2:] == (518, 392)
    assert nearest_shape(384, 512, 3 / 4, SHAPES).crop[2:] == (392, 518)
    assert nearest_shape(800, 300, 16 / 9, SHAPES).crop[2:] == (518, 294)


@pytest.mark.parametrize(
    "framing",
    [
        multiple_of_patch(200, 150, 128),
        multiple_of_patch(200, 150, 512),
        fixed_width(200, 150),
        nearest_shape(200, 150, 1.0, SHAPES),
    ],
)
def test_the_pixel_transform_says_what_each_pixel_shows(framing):
    view = ramp(200, 150)
    ready = prepare(view, 0, framing)
    height, width = ready.image.shape[:2]
    assert (width, height) == framing.crop[2:]
    v, u = np.mgrid[:height, :width] + 0.5
    there = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(ready.model_from_view).T
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(ready.image[..., 0] * 200 - there[..., 0])[inner].max() < 1
    assert np.abs(ready.image[..., 1] * 150 - there[..., 1])[inner].max() < 1


def test_padding_moves_the_transform_along():
    views = [prepare(ramp(200, 150), 0, fixed_width(200, 150))]
    views.append(prepare(ramp(150, 200), 1, fixed_width(150, 200)))
    padded = padded_alike(views)
    assert {view.image.shape for view in padded} == {(518, 518, 3)}
    top = (518 - views[0].image.shape[0]) // 2
    np.testing.assert_array_equal(padded[0].image[top:-top], views[0].image)
    assert (padded[0].image[:top] == 1).all()
    moved = padded[0].model_from_view @ [10, 10, 1] - views[0].model_from_view @ [10, 10, 1]
    np.testing.assert_allclose(moved, [0, top, 0])


def plane(width: int, height: int, matrix: np.ndarray) -> np.ndarray:
    """A slanted plane seen by every pixel of a map, in coordinates of the view's pixels."""
    v, u = np.mgrid[:height, :width] + 0.5
    there = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(matrix).T
    z = 500 + 0.1 * there[..., 0]
    return np.stack([there[..., 0], there[..., 1], z], -1).astype(np.float32)


def test_maps_come_back_to_the_pixels_of_the_view():
    matrix = np.array([[2.0, 0, -6], [0, 2.1, 3], [0, 0, 1]])
    points = plane(60, 60, matrix)
    out, confidence = resample_map(points, np.full((60, 60), 5, np.float32), matrix, (40, 30), 0.03)
    assert out.shape == (30, 40, 3)
    known = confidence > 1
    assert known[1:26, 4:32].all()
    assert not known[:, :3].any()
    assert not known[29].any()
    expected = plane(40, 30, np.eye(3))
    np.testing.assert_allclose(out[2:26, 4:32], expected[2:26, 4:32], atol=1e-3)
    assert (out[~known] == 0).all()


def test_nothing_is_interpolated_across_an_edge_or_next_to_the_unknown():
    points = np.zeros((10, 10, 3), np.float32)
    points[..., 2] = np.where(np.arange(10) < 5, 1, 2)[None]
    trust = np.full((10, 10), 3, np.float32)
    trust[0] = 1
    points[0] = 99
    matrix = np.diag([0.5, 0.5, 1])
    out, confidence = resample_map(points, trust, matrix, (20, 20), 0.03)
    assert set(np.unique(out[2:, :, 2])) == {1, 2}
    assert (confidence[:2] == 1).all()
    assert (confidence[2:] == 3).all()


def test_the_identity_changes_nothing():
    points = np.random.default_rng(0).normal(size=(7, 9, 3)).astype(np.float32) + 5
    trust = np.linspace(1, 9, 63, dtype=np.float32).reshape(7, 9)
    out, confidence = resample_map(points, trust, np.eye(3), (9, 7), 10)
    np.testing.assert_allclose(out, points, rtol=1e-6)
    np.testing.assert_allclose(confidence, trust, rtol=1e-6)


def test_bad_values_become_the_unknown():
    points = np.ones((2, 2, 3))
    points[0, 0, 1] = np.nan
    points[0, 1, 2] = np.inf
    cleaned, confidence = clean_map(points, np.array([[5, 5], [np.nan, 0.5]]))
    assert cleaned.dtype == np.float32
    np.testing.assert_array_equal(confidence, 1)
    np.testing.assert_array_equal(cleaned[1, 1], 1)
    assert np.isfinite(cleaned).all()


def test_scene_graphs():
    assert scene_pairs("complete", 3, 2, None, False) == [(0, 1), (0, 2), (1, 2)]
    assert scene_pairs("window", 4, 2, None, False) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert scene_pairs("star", 4, 2, None, False) == [(2, 0), (2, 1), (2, 3)]
    assert scene_pairs("star", 3, 2, 0, True) == [(0, 1), (0, 2), (1, 0), (2, 0)]
    with pytest.raises(RequestError, match="0 to 2"):
        scene_pairs("star", 3, 2, 3, True)


@pytest.mark.parametrize(
    ("views", "ordered", "multi_view", "expected"),
    [
        (8, False, False, "complete"),
        (9, True, False, "window"),
        (9, False, False, "star"),
        (3, True, True, "window"),
        (3, False, True, "star"),
    ],
)
def test_the_graph_is_chosen_by_the_number_of_views(views, ordered, multi_view, expected):
    assert choose_graph("auto", views, ordered, multi_view, 8) == expected
    assert choose_graph("complete", views, ordered, multi_view, 8) == "complete"


def test_unknown_graphs_are_refused():
    with pytest.raises(RequestError, match="Did you mean 'window'"):
        choose_graph("windows", 3, True, False, 8)
