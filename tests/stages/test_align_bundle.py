"""Sparse matches correct what bent pointmaps get wrong, and leave the rest alone."""

from __future__ import annotations

import re
from itertools import permutations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.pointmaps import PointmapPair, Pointmaps
from pipeline.artifacts.views import View, Views
from pipeline.geometry.depths import view_depths
from pipeline.geometry.start import start_from_tree
from pipeline.stage import LocalContext
from stages.align.bundle import (
    BundleOptions,
    _adjust,
    _errors,
    _Features,
    _model,
    _read,
    refine_with_matches,
)
from stages.align.optimise import AlignOptions, optimise
from stages.align.stage import AlignConfig, AlignStage
from tests.stages import dense_scene as scene

SIZE = (320, 240)


@pytest.fixture(scope="module")
def world():
    """Three views whose texture is fine enough for features."""
    cameras = [scene.camera(f"{k:03d}", a, *SIZE) for k, a in enumerate((-10.0, 0.0, 10.0))]
    rendered = [scene.render(camera) for camera in cameras]
    images = []
    for camera, (_, depth) in zip(cameras, rendered, strict=True):
        points = camera.unproject(depth)
        images.append(scene.texture(2.5 * points).astype(np.float32))
    return cameras, images, [depth for _, depth in rendered]


def pointmaps(world, bent: float, noise: float = 0.003) -> list[PointmapPair]:
    """Pairs whose depth is wrong by a smooth factor of its own, and noisy."""
    cameras, _, depths = world
    rng = np.random.default_rng(7)
    pairs = []
    for i, j in permutations(range(3), 2):
        maps = []
        for v in (i, j):
            factor = cv2.resize(rng.normal(size=(3, 4)), SIZE, interpolation=cv2.INTER_CUBIC)
            points = cameras[v].unproject(depths[v] * (1 + bent * factor))
            points = points @ cameras[i].rotation.T + cameras[i].translation
            maps.append((points + noise * 4 * rng.normal(size=points.shape)).astype(np.float32))
        trust = np.full(depths[0].shape, 5, np.float32)
        pairs.append(PointmapPair(f"{i:03d}", f"{j:03d}", *maps, trust, trust))
    return pairs


def aligned(world, bent: float):
    pairs = pointmaps(world, bent)
    start, _ = optimise(pairs, start_from_tree(pairs), AlignOptions(shared_focal=True))
    grays = {
        camera.name: View(camera.name, image).gray()
        for camera, image in zip(world[0], world[1], strict=True)
    }
    masks = {name: np.ones(gray.shape, bool) for name, gray in grays.items()}
    return start.cameras, (grays, masks, start.cameras, view_depths(pairs, start))


def turned(found: dict[str, Camera], truth: list[Camera]) -> float:
    """Largest error of a rotation between two views, degrees."""
    largest = 0.0
    for a, b in permutations(truth, 2):
        ours = found[b.name].rotation @ found[a.name].rotation.T
        error = ours @ (b.rotation @ a.rotation.T).T
        largest = max(largest, float(np.degrees(Rotation.from_matrix(error).magnitude())))
    return largest


def test_matches_correct_bent_pointmaps(world):
    before, given = aligned(world, 0.03)
    bundle = refine_with_matches(*given, BundleOptions(min_matches=40))
    assert not bundle.reason
    assert bundle.tracks > 60
    assert bundle.after < 0.5 * bundle.before
    assert turned(before, world[0]) > 0.3
    assert turned(bundle.cameras, world[0]) < 0.5 * turned(before, world[0])
    for name, camera in bundle.cameras.items():
        assert camera.fx == before[name].fx
    again = refine_with_matches(*given, BundleOptions(min_matches=40))
    for name, camera in bundle.cameras.items():
        np.testing.assert_array_equal(again.cameras[name].cam_from_world, camera.cam_from_world)


def test_good_cameras_and_scarce_matches_stay(world):
    before, given = aligned(world, 0.0)
    bundle = refine_with_matches(*given, BundleOptions(min_matches=40))
    assert bundle.reason == "they agree with the pointmaps"
    assert bundle.cameras == before
    bundle = refine_with_matches(*given, BundleOptions(min_matches=100_000))
    assert bundle.reason.endswith(" are in") and bundle.view in before
    assert bundle.cameras == before


def test_no_features_outside_the_mask(world):
    _, (grays, masks, cameras, depths) = aligned(world, 0.03)
    covered = {name: np.zeros_like(mask) for name, mask in masks.items()}
    bundle = refine_with_matches(grays, covered, cameras, depths, BundleOptions())
    assert bundle.tracks == 0


def test_photographs_of_other_shapes_have_a_lens_of_their_own():
    """Six perfect cameras, every other one upright."""
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    cameras = []
    for k in range(6):
        size = (480, 640) if k % 2 else (640, 480)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", 8 * k - 20, degrees=True).as_matrix()
        pose[2, 3] = 5
        cameras.append(Camera(f"{k:03d}", *size, 700, 700, size[0] / 2, size[1] / 2, pose))
    features = [
        _Features(camera.project(points)[0], np.zeros((200, 128), np.float32), points)
        for camera in cameras
    ]
    tracks = [[(view, point) for view in range(6)] for point in range(200)]
    for free_focals in (False, True):
        options = BundleOptions(shared_focal=True, free_focals=free_focals)
        model = _model(cameras, features, tracks, options)
        assert len(model.cameras) == 2
        _adjust(model, options)
        assert np.median(_errors(model)) < 1e-6
        refined = {c.name: _read(model, k, c) for k, c in enumerate(cameras, start=1)}
        assert turned(refined, cameras) < 1e-3
        assert all(abs(camera.fx - 700) < 0.1 for camera in refined.values())


def test_matches_that_are_asked_for_are_used_for_given_cameras_too(world, tmp_path):
    """Whatever `refine` is; and where they change nothing, it is said, and nothing changes."""
    views = Views(tuple(View(c.name, i) for c, i in zip(world[0], world[1], strict=True)))
    for bent in (0.03, 0.0):
        given = Cameras(tuple(aligned(world, bent)[0].values()))
        inputs = {"views": views, "pointmaps": Pointmaps(pointmaps(world, bent)), "cameras": given}
        config = AlignConfig(matches="always", match_min=40)
        context = LocalContext(config, tmp_path / str(bent), inputs, threads=2)
        AlignStage().run(context)
        found, before = context.result("cameras").by_name(), given.by_name()
        if bent:
            assert not context.warnings
            assert turned(found, world[0]) < 0.5 * turned(before, world[0])
        else:
            (said,) = context.warnings
            assert "change no camera: they agree with the pointmaps" in said
            for name, camera in before.items():
                off = found[name].cam_from_world - camera.cam_from_world
                assert np.abs(off).max() < 1e-14


def test_the_photograph_with_too_few_matches_is_called_by_its_name(world, tmp_path):
    pictures = zip(world[0], world[1], strict=True)
    views = Views(tuple(View(c.name, i, source_name=f"{c.name}.jpg") for c, i in pictures))
    given = Cameras(tuple(aligned(world, 0.0)[0].values()))
    inputs = {"views": views, "pointmaps": Pointmaps(pointmaps(world, 0.0)), "cameras": given}
    config = AlignConfig(matches="always", match_min=3000)
    context = LocalContext(config, tmp_path, inputs, threads=2)
    AlignStage().run(context)
    (said,) = context.warnings
    assert re.search(r": only \d+ are in \w+\.jpg \(align\.matches=always", said)


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"match_min": 3001}, "less than or equal to 3000"),
     ({"matches": "always", "hold_poses": True}, "hold_poses holds them")],
)  # fmt: skip
def test_matches_that_could_change_nothing_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        AlignConfig(**settings)


def test_the_stage_uses_matches_where_cameras_come_from_pointmaps_alone(world, tmp_path):
    views = Views(tuple(View(c.name, i) for c, i in zip(world[0], world[1], strict=True)))
    given = {"views": views, "pointmaps": Pointmaps(pointmaps(world, 0.03))}
    errors = {}
    for matches in ("auto", "never"):
        config = AlignConfig(matches=matches, match_min=40, shared_focal="always")
        context = LocalContext(config, tmp_path / matches, given, threads=2)
        AlignStage().run(context)
        errors[matches] = turned(context.result("cameras").by_name(), world[0])
        assert ("matched_points" in context.figures) == (matches == "auto")
    assert errors["auto"] < 0.5 * errors["never"]
