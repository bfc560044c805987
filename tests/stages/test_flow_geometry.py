"""What geometry says about flow, on planes of known depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from stages.flow.geometry import extend, occluded, pixel_grid, predicted_flow, splat_depth
from tests.stages import flow_scene as scene


def shifted(camera: Camera, x: float) -> Camera:
    pose = camera.cam_from_world.copy()
    pose[0, 3] -= x
    return replace(camera, name="shifted", cam_from_world=pose)


def test_splat_gives_the_nearest_surface() -> None:
    camera = scene.camera("000", 0)
    points = scene.cloud()
    depth = splat_depth(points.positions, points.scale, camera)
    _, truth = scene.photograph(camera)
    assert (depth > 0).all()
    assert (np.abs(depth - truth) < 0.02).mean() > 0.97
    assert depth[60, 80] == pytest.approx(scene.SQUARE)
    assert depth[5, 5] == pytest.approx(scene.WALL)


def test_splat_without_known_spacing_leaves_no_holes() -> None:
    camera = scene.camera("000", 0)
    points = scene.cloud(0.05)
    depth = splat_depth(points.positions, 0 * points.scale, camera)
    assert (depth > 0).mean() > 0.99


def test_splat_of_lone_points_and_points_behind() -> None:
    camera = scene.camera("000", 0)
    nothing = np.zeros((camera.height, camera.width))
    behind = np.array([[0, 0, -3.0], [0.1, 0, -3.0]])
    np.testing.assert_array_equal(splat_depth(behind, np.ones(2), camera), nothing)
    np.testing.assert_array_equal(splat_depth(np.zeros((0, 3)), np.ones(0), camera), nothing)
    speck = np.array([[0, 0, 3.0]])  # one pixel alone is noise
    np.testing.assert_array_equal(splat_depth(speck, np.full(1, 1e-3), camera), nothing)


def test_predicted_flow_of_a_sideways_step() -> None:
    camera = scene.camera("000", 0)
    depth = np.full((camera.height, camera.width), 4.0, np.float32)
    depth[:10] = 0
    flow, depth_in_j = predicted_flow(depth, camera, shifted(camera, 0.25))
    expected = -camera.fx * 0.25 / 4
    np.testing.assert_allclose(flow[10:, :, 0], expected, atol=1e-3)
    np.testing.assert_allclose(flow[10:, :, 1], 0, atol=1e-3)
    np.testing.assert_allclose(depth_in_j[10:], 4, atol=1e-5)
    assert not flow[:10].any()
    assert not depth_in_j[:10].any()


def test_predicted_flow_into_an_image_of_another_size() -> None:
    camera = scene.camera("000", 0)
    half = camera.resized(80, 60)
    depth = np.full((camera.height, camera.width), 4.0, np.float32)
    flow, _ = predicted_flow(depth, camera, half)
    grid = pixel_grid(camera.height, camera.width)
    np.testing.assert_allclose(grid + flow, (grid + 0.5) / 2 - 0.5, atol=1e-3)


def test_predicted_flow_is_the_motion_of_the_scene() -> None:
    a, b = scene.camera("000", -6), scene.camera("001", 6)
    _, depth = scene.photograph(a)
    flow, _ = predicted_flow(depth, a, b)
    landing = (pixel_grid(*depth.shape) + flow + 0.5).reshape(-1, 2)
    expected, _ = b.project(a.unproject(depth).reshape(-1, 3))
    np.testing.assert_allclose(landing, expected, atol=1e-3)


def test_extension_keeps_what_is_known_and_continues_it() -> None:
    flow = np.zeros((40, 50, 2), np.float32)
    known = np.zeros((40, 50), bool)
    flow[:, :25], known[:, :25] = (3, -1), True
    flow[:, 30:] = 1000  # unknown: must not leak
    filled = extend(flow, known, 0)
    np.testing.assert_allclose(filled, np.broadcast_to([3, -1], filled.shape), atol=1e-4)
    known[5:8, 5:8] = False
    flow[5:8, 5:8] = -1000
    filled = extend(flow, known, 2)
    np.testing.assert_allclose(filled, np.broadcast_to([3, -1], filled.shape), atol=1e-3)
    assert not extend(flow, np.zeros_like(known), 2).any()


def test_occlusion_is_where_the_square_hides_the_wall() -> None:
    a, b = scene.camera("000", -8), scene.camera("001", 8)
    depths = [scene.photograph(camera)[1] for camera in (a, b)]
    flow, depth_in_b = predicted_flow(depths[0], a, b)
    hidden = occluded(flow, depth_in_b, depths[1], 0.02)
    # Exactly: the line from b to the point meets the square's plane within the square.
    points = a.unproject(depths[0])
    ray = points - b.centre
    meets = b.centre + ray * ((scene.SQUARE - b.centre[2]) / ray[..., 2])[..., None]
    truth = (np.abs(meets[..., :2]) < scene.HALF).all(-1) & (points[..., 2] > scene.SQUARE + 0.1)
    assert truth.sum() > 200
    assert (hidden & truth).sum() > 0.85 * truth.sum()
    assert (hidden & ~truth).sum() < 0.05 * truth.sum()


def test_unknown_depth_hides_nothing() -> None:
    flow = np.zeros((10, 10, 2), np.float32)
    near, far = np.full((10, 10), 1, np.float32), np.full((10, 10), 2, np.float32)
    assert occluded(flow, far, near, 0.02).all()
    assert not occluded(flow, near, far, 0.02).any()
    assert not occluded(flow, far, 0 * near, 0.02).any()
    assert not occluded(flow, 0 * far, near, 0.02).any()
    assert not occluded(flow + 50, far, near, 0.02).any()
