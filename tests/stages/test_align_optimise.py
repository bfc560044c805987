"""The joint optimisation: its derivatives, what it holds fixed, how near it comes to the truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.pointmaps import PointmapPair, Pointmaps
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import View, Views
from pipeline.geometry.similarity import refined_pose
from pipeline.geometry.start import Start, start_from_cameras, start_from_tree
from pipeline.geometry.world import move_camera, similarity_between
from pipeline.stage import LocalContext
from stages.align.linearise import linearise_view
from stages.align.optimise import AlignOptions, optimise
from stages.align.stage import AlignConfig, AlignStage
from tests.stages import dense_scene as scene

ANGLES = (-24.0, -10.0, 4.0, 18.0)
EVERY_PAIR = tuple(permutations(range(4), 2))

SCALE = Scale("mm", "length", 2.5)


@pytest.fixture(scope="module")
def world():
    cameras, images, depths, _ = scene.scene(ANGLES)
    return cameras, images, depths


def stand_in(world, pairs=EVERY_PAIR, noise=0.01, outliers=0.05, seed=0) -> list[PointmapPair]:
    """What a model says: noise in all directions, holes, outliers, a scale per pair."""
    cameras, _, depths = world
    rng = np.random.default_rng(seed)
    found = []
    for i, j in pairs:
        scale = rng.uniform(0.3, 3)
        maps, trust = [], []
        for v in (i, j):
            points = cameras[v].unproject(depths[v])
            points = points @ cameras[i].rotation.T + cameras[i].translation
            points = points + noise * depths[v][..., None] * rng.normal(size=points.shape)
            wild = rng.random(depths[v].shape) < outliers
            points[wild] += rng.normal(size=(wild.sum(), 3))
            confidence = rng.uniform(3, 9, depths[v].shape)
            confidence[wild & (rng.random(wild.shape) < 0.5)] = 1.5
            confidence[10:30, 20:40] = 1
            maps.append((scale * points).astype(np.float32))
            trust.append(confidence.astype(np.float32))
        found.append(PointmapPair(f"{i:03d}", f"{j:03d}", *maps, *trust))
    return found


def errors(found: dict[str, Camera], truth: list[Camera]) -> tuple[float, float, float]:
    """Largest errors: rotation in degrees, centre and focal length relative."""
    cameras = [found[camera.name] for camera in truth]
    motion = similarity_between(cameras, truth)
    moved = [move_camera(camera, motion) for camera in cameras]
    rotation = max(
        np.degrees(Rotation.from_matrix(m.rotation @ t.rotation.T).magnitude())
        for m, t in zip(moved, truth, strict=True)
    )
    extent = np.ptp([t.centre for t in truth], axis=0).max()
    centre = max(np.linalg.norm(m.centre - t.centre) for m, t in zip(moved, truth, strict=True))
    focal = max(abs(c.fx / t.fx - 1) for c, t in zip(cameras, truth, strict=True))
    return float(rotation), float(centre / extent), float(focal)


def test_the_normal_equations_are_the_derivatives_of_the_loss():
    rng = np.random.default_rng(2)
    count, pixels = 2, rng.uniform(-50, 50, (5, 2))
    base = {
        "log_depth": np.log(rng.uniform(2, 4, 5)),
        "camera": rng.normal(0, 0.3, 7),
        "pairs": rng.normal(0, 0.3, (count, 7)),
    }
    points = rng.normal(size=(count, 5, 3)) + np.array([0, 0, 3])
    weight, near = rng.uniform(0.5, 2, (count, 5)), rng.uniform(0.2, 0.5, (count, 5))
    weight[0, 1] = 0

    def loss(camera_step, pair_step, depth_step):
        turn = Rotation.from_rotvec
        outputs = (
            np.zeros((21, 21)), np.zeros(21), np.zeros((5, 21)), np.zeros(5), np.zeros(5),
        )  # fmt: skip
        camera, pairs = base["camera"], base["pairs"]
        value = linearise_view(
            pixels, base["log_depth"] + depth_step,
            (turn(camera_step[:3]) * turn(camera[:3])).as_matrix(),
            camera[3:6] + camera_step[3:6],
            np.array([80.0, 70.0]) * np.exp(camera_step[6]),
            (turn(pair_step[:, :3]) * turn(pairs[:, :3])).as_matrix(),
            np.exp(pairs[:, 6] + pair_step[:, 6]), pairs[:, 3:6] + pair_step[:, 3:6],
            points, weight, near, 0.4, *outputs, np.zeros((count, 5)),
        )  # fmt: skip
        return value, outputs

    zero = (np.zeros(7), np.zeros((count, 7)), np.zeros(5))
    _, (_, gradient, _, _, depth_gradient) = loss(*zero)
    step = 1e-6
    for k in range(21 + 5):
        values = []
        for sign in (1, -1):
            moved = [part.copy() for part in zero]
            flat = np.concatenate([part.ravel() for part in moved])
            flat[k] += sign * step
            moved = [flat[:7], flat[7:21].reshape(count, 7), flat[21:]]
            values.append(loss(*moved)[0])
        numeric = (values[0] - values[1]) / (2 * step)
        analytic = gradient[k] if k < 21 else depth_gradient[k - 21]
        assert numeric == pytest.approx(analytic, rel=1e-4, abs=1e-6)


def test_noisy_pointmaps_with_outliers_give_the_cameras(world):
    pairs = stand_in(world)
    start = start_from_tree(pairs)
    better, residual = optimise(pairs, start, AlignOptions())
    rotation, centre, focal = errors(better.cameras, world[0])
    assert rotation < 0.2
    assert centre < 0.01
    assert focal < 0.01
    assert centre < errors(start.cameras, world[0])[1]
    assert 0.01 < residual < 0.05


def test_pairs_in_one_order_suffice(world):
    pairs = stand_in(world, ((0, 1), (1, 2), (2, 3), (0, 2), (1, 3)))
    better, _ = optimise(pairs, start_from_tree(pairs), AlignOptions())
    rotation, centre, focal = errors(better.cameras, world[0])
    assert rotation < 0.6
    assert centre < 0.02
    assert focal < 0.015


def disturbed(cameras: list[Camera], degrees: float, focal: float) -> dict[str, Camera]:
    rng = np.random.default_rng(4)
    moved = {}
    for camera in cameras:
        pose = camera.cam_from_world.copy()
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(degrees), 3)).as_matrix()
        pose[:3, :3] = turn @ pose[:3, :3]
        moved[camera.name] = replace(
            camera, cam_from_world=pose, fx=camera.fx * focal, fy=camera.fy * focal
        )
    return moved


def test_given_poses_stay_and_focal_lengths_are_found(world):
    pairs = stand_in(world)
    start = start_from_cameras(pairs, disturbed(world[0], 0, 1.05))
    better, _ = optimise(pairs, start, AlignOptions(free_poses=False))
    for camera in world[0]:
        np.testing.assert_allclose(
            better.cameras[camera.name].cam_from_world, camera.cam_from_world, atol=1e-12
        )
        assert better.cameras[camera.name].fx == pytest.approx(camera.fx, rel=0.01)


def test_given_focal_lengths_stay_and_poses_are_found(world):
    pairs = stand_in(world)
    start = start_from_cameras(pairs, disturbed(world[0], 2, 1.0))
    assert errors(start.cameras, world[0])[0] > 1
    better, _ = optimise(pairs, start, AlignOptions(free_focals=False))
    assert errors(better.cameras, world[0])[0] < 0.2
    for camera in world[0]:
        assert better.cameras[camera.name].fx == camera.fx


def test_one_focal_length_for_all(world):
    pairs = stand_in(world)
    better, _ = optimise(pairs, start_from_tree(pairs), AlignOptions(shared_focal=True))
    focals = [camera.fx for camera in better.cameras.values()]
    assert np.ptp(focals) < 1e-9
    assert focals[0] == pytest.approx(world[0][0].fx, rel=0.01)


def test_no_iterations_or_no_pairs_change_nothing(world):
    pairs = stand_in(world)
    start = start_from_cameras(pairs, disturbed(world[0], 1, 1.02))
    kept, residual = optimise(pairs, start, AlignOptions(iterations=0))
    assert kept is start
    assert residual > 2 * optimise(pairs, start, AlignOptions())[1], "it is that of the start"
    nothing = Start({}, [None] * len(pairs))
    assert optimise(pairs, nothing, AlignOptions()) == (nothing, 0.0)


def test_provisional_cameras_are_improved_in_their_world(world, tmp_path):
    cameras, images, _ = world
    rough = Cameras(
        tuple(disturbed(cameras, 1, 1.02).values()),
        np.diag([2.0, 2, 2, 1]),
        SCALE,
        provisional=True,
    )
    context = LocalContext(
        AlignConfig(),
        tmp_path,
        {
            "views": Views(tuple(View(c.name, i) for c, i in zip(cameras, images, strict=True))),
            "pointmaps": Pointmaps(stand_in(world)),
            "cameras": rough,
        },
        threads=2,
    )
    AlignStage().run(context)
    kept = context.result("cameras")
    assert not kept.provisional
    assert kept.scale == SCALE
    np.testing.assert_array_equal(kept.input_from_world, rough.input_from_world)
    rotation, _, focal = errors(kept.by_name(), cameras)
    assert rotation < 0.2
    assert focal < 0.01
    assert context.figures["alignment_residual"] > 0
    # The world is that of the cameras given, so far as they agree on one.
    offset = similarity_between(list(kept.cameras), list(rough.cameras))
    assert offset[0] == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(offset[1], np.eye(3), atol=1e-6)


def test_focal_lengths_from_exif_are_kept(world, tmp_path):
    cameras, images, _ = world
    rough = disturbed(cameras, 1, 1.0)
    views = tuple(View(c.name, i, focal_px=c.fx) for c, i in zip(cameras, images, strict=True))
    given = {
        "views": Views(views),
        "pointmaps": Pointmaps(stand_in(world)),
        "cameras": Cameras(tuple(rough.values()), provisional=True),
    }
    context = LocalContext(AlignConfig(), tmp_path / "a", given, threads=2)
    AlignStage().run(context)
    for found, truth in zip(context.result("cameras").cameras, cameras, strict=True):
        assert found.fx == pytest.approx(truth.fx, rel=1e-9)
    context = LocalContext(AlignConfig(hold_focals="never"), tmp_path / "b", given, threads=2)
    AlignStage().run(context)
    assert context.result("cameras").cameras[0].fx != cameras[0].fx


def test_a_pose_is_refined_under_noise_and_outliers():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (2000, 3)) + np.array([0, 0, 4])
    rays = points[:, :2] / points[:, 2:] + rng.normal(0, 0.01, (2000, 2))
    rays[:100] += rng.normal(0, 0.2, (100, 2))
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec([0.05, -0.04, 0.03]).as_matrix()
    start[:3, 3] = 0.1, 0.1, -0.2
    found = refined_pose(start, points, rays)
    assert np.degrees(Rotation.from_matrix(found[:3, :3]).magnitude()) < 0.1
    assert np.abs(found[:3, 3]).max() < 0.01


def test_similarity_between_sets_of_cameras(world):
    cameras = world[0]
    motion = (1.7, Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), np.ones(3))
    moved = [move_camera(camera, motion) for camera in cameras]
    found = similarity_between(cameras, moved)
    assert found[0] == pytest.approx(1.7)
    np.testing.assert_allclose(found[1], motion[1], atol=1e-12)
    np.testing.assert_allclose(found[2], motion[2], atol=1e-12)
