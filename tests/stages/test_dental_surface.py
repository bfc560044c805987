"""Dense surface of the teeth, end to end on a made-up dentition with exact depth."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.artifacts.confidence import COMPLETED, FILLED
from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.turned_sheet import render_turned, turned_sheet
from tests.stages.dental_arch_scene import scene

GUM, TOOTH, GLOVE = 1, 2, 3


@functools.cache
def inputs():  # type: ignore[no-untyped-def]
    return scene()


@functools.cache
def surface() -> ArchSurface:
    return dense_surface(*inputs()[:4], threads=2)


def errors(result: ArchSurface) -> np.ndarray:
    """Depth errors in mm on the teeth of all views."""
    parts = []
    for view, (depth, _, kind) in zip(result.views, inputs()[4], strict=True):
        assert view is not None
        both = (kind == TOOTH) & (view.depth > 0)
        parts.append(np.abs(view.depth - depth)[both])
    return np.concatenate(parts)


def test_depth_is_near_the_truth_and_better_than_the_crown_shapes() -> None:
    swept = errors(surface())
    shapes = errors(dense_surface(*inputs()[:4], options=SurfaceOptions(rounds=()), threads=2))
    assert np.median(swept) < 0.15
    assert np.percentile(swept, 90) < 0.6
    assert np.median(swept) < 0.6 * np.median(shapes)


def test_teeth_are_covered_and_gloves_and_the_dark_are_not() -> None:
    for view, (_, _, kind) in zip(surface().views, inputs()[4], strict=True):
        assert view is not None
        shown = view.depth > 0
        assert shown[kind == TOOTH].mean() > 0.95
        assert shown[kind == GUM].mean() > 0.2
        assert not shown[kind == GLOVE].any()
        assert shown[kind == 0].mean() < 0.01
        assert view.depth.dtype == view.normal.dtype == view.confidence.dtype == np.float32


def test_gum_that_is_seen_in_stripes_leaves_no_fringes() -> None:
    images, valid, dentitions, fit, truth = inputs()
    stripes = np.arange(images[0].shape[1]) % 24 < 5
    usable = [
        mask & ((kind != GUM) | stripes) for mask, (_, _, kind) in zip(valid, truth, strict=True)
    ]
    options = SurfaceOptions(rounds=())
    fringed = dense_surface(images, usable, dentitions, fit, options)
    for view, (_, _, kind) in zip(fringed.views, truth, strict=True):
        assert view is not None
        gum = (cv2.distanceTransform(np.uint8(kind != TOOTH), cv2.DIST_L2, 5) > 8) & (kind == GUM)
        assert (gum & stripes).sum() > 100
        assert (view.depth[gum & stripes] > 0).mean() < 0.02
        assert (view.depth[kind == TOOTH] > 0).mean() > 0.95


def test_gum_is_shown_only_up_to_its_height() -> None:
    low = dense_surface(*inputs()[:4], options=SurfaceOptions(gum_height=1.5, rounds=()))
    high = dense_surface(*inputs()[:4], options=SurfaceOptions(gum_height=4.0, rounds=()))
    # Zeniths lie 8 mm above the upper edges at y = 0.
    assert low.positions[:, 1].max() < 9.7
    assert 10.5 < high.positions[:, 1].max() < 12.2


def test_gum_ends_in_the_photographs_where_the_cloud_ends() -> None:
    """What they show beyond its even rim is nothing that a fit could explain."""
    images, valid, dentitions, fit, truth = inputs()
    notches = np.arange(images[0].shape[1]) % 100 < 30
    usable = [
        mask & ((kind != GUM) | ~notches) for mask, (_, _, kind) in zip(valid, truth, strict=True)
    ]
    notched = dense_surface(images, usable, dentitions, fit, SurfaceOptions(rounds=()), threads=2)
    tree = cKDTree(notched.positions)
    for view, placed, (_, _, kind) in zip(notched.views, fit.views, truth, strict=True):
        rows, columns = np.nonzero((view.depth > 0) & (kind == GUM))
        camera = placed.camera("", kind.shape[1], kind.shape[0])
        z = view.depth[rows, columns].astype(np.float64)
        x = (columns + 0.5 - camera.cx) / camera.fx * z
        y = (rows + 0.5 - camera.cy) / camera.fy * z
        world = (np.stack([x, y, z], 1) - camera.translation) @ camera.rotation
        assert len(rows) > 1000 and (tree.query(world)[0] < 0.3).mean() > 0.99


def test_no_glove_in_the_cloud() -> None:
    result = surface()
    assert len(result.positions) > 10_000
    # The finger is the only thing that is bright and hardly coloured.
    spread = result.colors.max(axis=1) - result.colors.min(axis=1)
    assert not ((spread < 0.06) & (result.colors.min(axis=1) > 0.7)).any()
    assert 0.4 < result.tooth.mean() < 0.95


def test_normals_face_the_cameras_and_confidence_tells_what_is_known() -> None:
    result = surface()
    fit = inputs()[3]
    for view, placed in zip(result.views, fit.views, strict=True):
        assert view is not None
        shown = view.depth > 0
        assert np.all(view.confidence[~shown] == 1)
        assert np.all(view.confidence[shown] > 1)
        assert np.all(view.normal[~shown] == 0)
        length = np.linalg.norm(view.normal[shown], axis=1)
        np.testing.assert_allclose(length, 1, atol=1e-4)
        toward = -(view.normal[shown] @ placed.cam_from_world[2, :3])
        assert np.percentile(toward, 5) > 0
    # What no photographs agree on is sure enough for the mesh, and no more than fill elsewhere.
    assert COMPLETED < result.confidence.min() <= FILLED
    # In front three photographs agree; at the ends of the arch one of them is alone.
    aside = np.abs(result.positions[:, 0])
    front, ends = result.confidence[aside < 8], result.confidence[aside > 20]
    assert np.median(front) > np.median(ends) + 1


def test_exposures_are_brought_together() -> None:
    gains = surface().gains
    assert gains.shape == (3, 3)
    np.testing.assert_allclose(gains[0], 1 / 0.9, rtol=0.02)
    np.testing.assert_allclose(gains[1], 1)
    np.testing.assert_allclose(gains[2], 1, rtol=0.02)


def test_cloud_lies_on_the_surface_in_one_layer() -> None:
    result = surface()
    for view in range(3):
        placed = inputs()[3].views[view]
        depth, jaw, kind = inputs()[4][view]
        local = result.positions[result.tooth] @ placed.cam_from_world[:3, :3].T
        local = local + placed.cam_from_world[:3, 3]
        x = (placed.focal * local[:, 0] / local[:, 2] + depth.shape[1] / 2).astype(int)
        y = (placed.focal * local[:, 1] / local[:, 2] + depth.shape[0] / 2).astype(int)
        # Of the points on one pixel, those not hidden by another surface lie on this one.
        near = np.abs(local[:, 2] - depth[y, x]) < 3
        inside = near & (kind[y, x] == TOOTH) & (jaw[y, x] > 0)
        assert np.median(np.abs(local[:, 2] - depth[y, x])[inside]) < 0.25


def test_threads_change_nothing() -> None:
    one = dense_surface(*inputs()[:4], threads=1)
    two = surface()
    for field in ("positions", "colors", "normals", "confidence", "tooth", "faces", "gains"):
        assert getattr(one, field).tobytes() == getattr(two, field).tobytes(), field
    for a, b in zip(one.views, two.views, strict=True):
        assert a is not None
        assert b is not None
        assert a.depth.tobytes() == b.depth.tobytes()
        assert a.normal.tobytes() == b.normal.tobytes()
        assert a.confidence.tobytes() == b.confidence.tobytes()


def test_views_without_teeth_or_camera_are_skipped() -> None:
    images, valid, dentitions, fit, _ = inputs()
    placed = (fit.views[0], fit.views[1], None)
    result = dense_surface(
        images, valid, dentitions, dataclasses.replace(fit, views=placed), threads=2
    )
    assert result.views[2] is None
    assert result.views[0] is not None
    blind = dense_surface(
        images, valid, [None, *dentitions[1:]], fit, SurfaceOptions(rounds=()), threads=2
    )
    assert blind.views[0] is None
    assert blind.views[1] is not None
    np.testing.assert_array_equal(blind.gains[0], 1)


def test_masked_pixels_give_no_depth_and_no_colour() -> None:
    images, valid, dentitions, fit, _ = inputs()
    width = valid[1].shape[1]
    masks = [v.copy() for v in valid]
    masks[1][:, width // 2 :] = False
    spoilt = [image.copy() for image in images]
    spoilt[1][:, width // 2 :] = [0, 0, 1]
    result = dense_surface(spoilt, masks, dentitions, fit, SurfaceOptions(rounds=()), threads=2)
    view = result.views[1]
    assert view is not None
    assert not (view.depth > 0)[:, width // 2 :].any()
    blue = result.colors[:, 2] > result.colors[:, 0] + 0.1
    assert blue.mean() < 0.002


def test_wrong_input_is_refused() -> None:
    images, valid, dentitions, fit, _ = inputs()
    with pytest.raises(ValueError, match="one image, mask, dentition and camera"):
        dense_surface(images[:2], valid, dentitions, fit)
    with pytest.raises(ValueError, match="working image"):
        dense_surface([image[:-1] for image in images], valid, dentitions, fit)
    with pytest.raises(ValueError, match="no photograph was placed"):
        dense_surface(images, valid, [None, None, None], fit)


def test_turned_sheet_shows_the_surface_turned() -> None:
    sheet = turned_sheet(surface(), yaws=(-25, 0, 25), width=160, height=90)
    assert sheet.shape == (180, 480, 3)
    assert sheet.dtype == np.uint8
    background = sheet[0, 0]
    painted = (sheet != background).any(axis=2)
    for column in range(3):
        assert painted[:90, 160 * column : 160 * (column + 1)].mean() > 0.1


def test_patients_left_is_on_the_right_of_the_picture() -> None:
    result = surface()
    red = result.positions[:, :1] > 3
    marked = dataclasses.replace(
        result, colors=np.where(red, [[1, 0, 0]], [[0, 0, 1]]).astype(np.float32)
    )
    image = render_turned(marked, 0, 0, 160, 90).astype(int)
    half = image.shape[1] // 2
    left, right = image[:, :half], image[:, half:]
    assert (right[..., 0] > right[..., 2] + 100).sum() > 100
    assert (left[..., 0] > left[..., 2] + 100).sum() == 0
