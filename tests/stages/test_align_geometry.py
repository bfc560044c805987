"""Similarities, focal lengths, poses and the spanning tree, on exact and on spoiled input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.graph import spanning_forest
from pipeline.geometry.similarity import (
    pose_from_points,
    robust_similarity,
    similarity,
    weiszfeld_focal,
)
from pipeline.geometry.world import move_camera, normalising_similarity

RNG = np.random.default_rng(0)
TURN = Rotation.from_euler("xyz", [20, -35, 10], degrees=True).as_matrix()
SHIFT = np.array([0.3, -2.0, 1.0])


def wavy_view(focal: float = 90.0) -> tuple[Camera, np.ndarray]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN, SHIFT
    lens = Camera("000", 80, 60, focal, focal, 40, 30, pose)
    v, u = np.mgrid[:60, :80]
    return lens, 3 + 0.4 * np.sin(u / 9) + 0.3 * np.cos(v / 7)


def test_similarity_is_exact_without_noise_and_robust_against_outliers():
    source = RNG.normal(size=(500, 3))
    target = 1.7 * source @ TURN.T + SHIFT
    weight = RNG.uniform(0.1, 1, 500)
    scale, rotation, shift = similarity(source, target, weight)
    assert scale == pytest.approx(1.7, abs=1e-9)
    np.testing.assert_allclose(rotation, TURN, atol=1e-9)
    np.testing.assert_allclose(shift, SHIFT, atol=1e-9)
    target[:100] += RNG.normal(size=(100, 3)) * 3 + 2
    scale, rotation, shift = robust_similarity(source, target, weight, 20)
    assert scale == pytest.approx(1.7, abs=2e-3)
    np.testing.assert_allclose(rotation, TURN, atol=2e-3)


def test_similarity_never_mirrors():
    source = RNG.normal(size=(50, 3))
    _, rotation, _ = similarity(source, source * (1, 1, -1), np.ones(50))
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_similarity_needs_three_points():
    with pytest.raises(ValueError, match="three points"):
        similarity(np.eye(3), np.eye(3), np.array([1.0, 1.0, 0.0]))


def test_focal_and_pose_from_a_pointmap_with_outliers():
    lens, depth = wavy_view()
    world = lens.unproject(depth)
    local = world @ lens.rotation.T + lens.translation
    weight = np.ones(depth.shape)
    assert weiszfeld_focal(local, weight) == pytest.approx(90, rel=1e-6)
    bad = RNG.random(depth.shape) < 0.1
    local[bad] *= RNG.uniform(0.5, 1.5, (bad.sum(), 3))
    assert weiszfeld_focal(local, weight, 30) == pytest.approx(90, rel=0.02)
    world[bad] += RNG.normal(size=(bad.sum(), 3))
    pose = pose_from_points(world, weight, 90.0)
    assert pose is not None
    np.testing.assert_allclose(pose, lens.cam_from_world, atol=0.02)
    assert pose_from_points(world, np.zeros(depth.shape), 90.0) is None
    assert weiszfeld_focal(-local, weight) == 0.0


def test_spanning_tree_takes_the_best_edges_and_the_largest_tree_first():
    edges = [("a", "b", 1.0), ("b", "c", 3.0), ("a", "c", 2.0), ("d", "e", 9.0), ("e", "f", 0.0)]
    assert spanning_forest(edges) == [[1, 2], [3]]
    assert spanning_forest([("a", "b", 0.0)]) == []


def test_normalised_world_has_unit_depth_and_y_down():
    lens, depth = wavy_view()
    points = lens.unproject(depth).reshape(-1, 3)
    motion = normalising_similarity([lens], points)
    moved = motion[0] * points @ motion[1].T + motion[2]
    camera = move_camera(lens, motion)
    np.testing.assert_allclose(np.median(moved, axis=0), 0, atol=1e-9)
    assert camera.project(np.zeros((1, 3)))[1][0] == pytest.approx(1)
    np.testing.assert_allclose(camera.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(camera.project(moved)[0], lens.project(points)[0], atol=1e-6)
