"""Pose errors, registration and refinement of cameras, on cases with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.pose_metrics import (
    auc,
    centres_of,
    pose_figures,
    position_errors,
    relative_errors,
    root_mean_square,
    rotation_errors,
    rpe,
)
from pipeline.geometry.rigid import moved_by, rotation_angle
from pipeline.geometry.similarity import camera_similarity, similarity
from stages.evaluate.held_out import common_lens, register, without_lens
from stages.evaluate.refinement import normal_equations, refine_camera
from stages.splatting.rendering import render
from tests.stages.evaluate_scene import arc, moved_world, pose, rotation, textured_scene


def test_rotation_angles_of_any_size() -> None:
    for degrees in (1e-6, 0.5, 90, 179.9):
        angle = np.degrees(rotation_angle(rotation((1, 2, -3), degrees)))
        assert float(angle) == pytest.approx(degrees, rel=1e-6)


def test_errors_of_known_offsets() -> None:
    truth = arc([-30, 0, 30])
    turned = truth.copy()
    turned[1, :3] = rotation((0, 0, 1), 2.0) @ truth[1, :3]
    np.testing.assert_allclose(rotation_errors(turned, truth), [0, 2, 0], atol=1e-6)
    np.testing.assert_allclose(position_errors(turned, truth), 0, atol=1e-9)
    shifted = np.array([pose(one[:3, :3], c + np.array([0.3, 0, 0.4])) for one, c in
                        zip(truth, centres_of(truth), strict=True)])  # fmt: skip
    np.testing.assert_allclose(position_errors(shifted, truth), 0.5)
    assert root_mean_square(position_errors(shifted, truth)) == pytest.approx(0.5)


def test_ate_and_rpe_agree_with_a_computation_by_hand() -> None:
    """Written out with world_from_cam matrices, as Sturm et al. state them."""
    random = np.random.default_rng(3)
    truth = arc([-40, -25, -5, 10, 35])
    estimated = np.array([moved_by(random.normal(0, 0.05, 6), one) for one in truth])
    t, s = np.linalg.inv(truth), np.linalg.inv(estimated)
    hand = np.sqrt(np.mean([((a[:3, 3] - b[:3, 3]) ** 2).sum() for a, b in zip(t, s, strict=True)]))
    assert root_mean_square(position_errors(estimated, truth)) == pytest.approx(hand, abs=1e-4)
    turns, shifts = [], []
    for i in range(4):
        error = np.linalg.inv(np.linalg.inv(t[i]) @ t[i + 1]) @ (np.linalg.inv(s[i]) @ s[i + 1])
        cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
        turns.append(np.degrees(np.arccos(cosine)))
        shifts.append(np.linalg.norm(error[:3, 3]))
    by_turn, by_shift = rpe(estimated, truth)
    assert by_turn == pytest.approx(np.sqrt(np.mean(np.square(turns))), abs=1e-4)
    assert by_shift == pytest.approx(np.sqrt(np.mean(np.square(shifts))), abs=1e-4)


def test_relative_errors_need_no_alignment() -> None:
    truth = arc([-30, 0, 20, 45])
    same = moved_world(truth, 3.0, rotation((1, 1, 0), 70), np.array([5.0, -2, 1]))
    np.testing.assert_allclose(relative_errors(same, truth), 0, atol=1e-5)
    wrong = truth.copy()
    wrong[3, :3] = rotation((1, 0, 0), 7) @ truth[3, :3]  # seen from the other three
    errors = relative_errors(wrong, truth)
    assert errors.shape == (6,)
    pairs_with_3 = [2, 4, 5]
    assert (errors[pairs_with_3] >= 7 - 1e-6).all()
    np.testing.assert_allclose(np.delete(errors, pairs_with_3), 0, atol=1e-5)


def test_auc_is_the_area_under_the_recall() -> None:
    errors = np.array([0.0, 2.0, 4.0, 20.0, np.inf])
    grid = (np.arange(500_000) + 0.5) / 500_000 * 10
    recall = (errors[:, None] <= grid).mean(0)
    assert auc(errors, 10) == pytest.approx(recall.mean(), abs=1e-4)
    assert auc(np.zeros(3), 5) == 1
    assert auc(np.full(3, np.inf), 30) == 0


def test_pose_figures_name_their_units() -> None:
    truth = arc([-30, 0, 30])
    largest = np.linalg.norm(centres_of(truth)[0] - centres_of(truth)[2])
    estimated = np.array(
        [pose(one[:3, :3], c + np.array([0, 0.1 * k, 0])) for k, (one, c) in
         enumerate(zip(truth, centres_of(truth), strict=True))]
    )  # fmt: skip
    figures = pose_figures(estimated, truth, np.array([1.0, 1.02, 0.97]), 4, "mm")
    assert figures["translation_percent"]["max"] == pytest.approx(100 * 0.2 / largest)
    assert figures["translation_percent"]["median"] == pytest.approx(100 * 0.1 / largest)
    assert figures["ate_rmse"] == pytest.approx(np.sqrt((0.01 + 0.04) / 3))
    assert figures["focal_error_percent"] == pytest.approx(2)
    assert (figures["views"], figures["placed"], figures["ate_unit"]) == (4, 3, "mm")
    assert figures["auc_30"] <= 0.5  # three of the six pairs have the view that was not placed


def test_camera_similarity_is_recovered() -> None:
    source = arc([-50, -10, 15, 40])
    turn, shift = rotation((1, -2, 0.5), 130), np.array([3.0, -1, 7])
    found = camera_similarity(source, moved_world(source, 2.5, turn, shift), 10.0)
    assert found[0] == pytest.approx(2.5)
    np.testing.assert_allclose(found[1], turn, atol=1e-9)
    np.testing.assert_allclose(found[2], shift, atol=1e-9)


def test_orientations_help_where_centres_lie_near_a_line() -> None:
    """Of the rotation about the line, the centres know next to nothing."""
    random = np.random.default_rng(0)
    true = np.array([pose(np.eye(3), (x, 0, 0)) for x in (-1.0, 0, 1)])
    ours, by_centres = [], []
    for _ in range(20):
        noisy = np.array([moved_by(random.normal(0, 0.01, 6), one) for one in true])
        _, turn, _ = camera_similarity(noisy, true, 5.0)
        ours.append(np.degrees(rotation_angle(turn)))
        _, turn, _ = similarity(centres_of(noisy), centres_of(true), np.ones(3))
        by_centres.append(np.degrees(rotation_angle(turn)))
    assert np.max(ours) < 2
    assert np.median(by_centres) > 10


def test_two_cameras_suffice_and_one_does_not() -> None:
    source = arc([-20, 20])
    turn, shift = rotation((0, 1, 1), 40), np.array([1.0, 2, 3])
    scale, found, _ = camera_similarity(source, moved_world(source, 0.5, turn, shift), 10.0)
    assert scale == pytest.approx(0.5)
    np.testing.assert_allclose(found, turn, atol=1e-9)
    with pytest.raises(ValueError, match="two places"):
        camera_similarity(source[:1], source[:1], 10.0)


def named(poses: np.ndarray, focal: float, cx: float = 32) -> dict[str, Camera]:
    return {
        f"{k:03d}": Camera(f"{k:03d}", 64, 48, focal, focal, cx, 24, one)
        for k, one in enumerate(poses)
    }


def test_registered_cameras_see_the_scene_as_the_true_ones() -> None:
    truth = named(arc([-40, -20, 0, 20, 40]), 100.0)
    turn, shift = rotation((1, 2, 3), 100), np.array([4.0, 5, -6])
    world = moved_world(arc([-40, 0, 40]), 0.2, turn, shift)  # the world of the reconstruction
    cameras = dict(zip(("000", "002", "004"), named(world, 103.0, 33.0).values(), strict=True))
    registration = register(cameras, truth, depth=2.0)
    assert registration.focal_ratio == pytest.approx(1.03)
    points = np.random.default_rng(1).uniform(-1, 1, (30, 3))
    ours = 0.2 * points @ turn.T + shift
    np.testing.assert_allclose(registration.to_truth(ours), points, atol=1e-9)
    camera = registration.registered(truth["001"])
    expected, depth = replace(truth["001"], fx=103.0, fy=103.0, cx=33.0).project(points)
    pixels, our_depth = camera.project(ours)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(our_depth, 0.2 * depth)
    back = registration.pose_in_truth(camera.cam_from_world)
    np.testing.assert_allclose(back, truth["001"].cam_from_world, atol=1e-9)


def test_too_few_true_cameras_are_explained() -> None:
    truth = named(arc([-40, 0]), 100.0)
    with pytest.raises(RequestError, match="1 of the 1 reconstructed cameras"):
        register({"000": truth["000"]}, truth, 10.0)


def test_lens_of_the_views_is_taken_out_of_held_out_photographs() -> None:
    lens = "SIMPLE_RADIAL 64 48 70 32 24 -0.2"
    plain = View("000", np.zeros((48, 64, 3), np.float32), source_size=(64, 48))
    assert common_lens([plain, plain]) == ""
    bent = [replace(plain, lens_taken_out=text) for text in (lens, lens.replace("70", "70.01"))]
    assert common_lens(bent) in {view.lens_taken_out for view in bent}
    assert common_lens([plain, bent[0]]) is None
    assert common_lens([bent[0], replace(plain, lens_taken_out=lens.replace("70", "80"))]) is None
    v, u = np.mgrid[:48, :64] + 0.5
    ray = np.stack([(u - 32) / 70, (v - 24) / 70], -1)
    # the photograph of x-coordinates on a plane: at each pixel the pinhole ray that ends there
    square = (ray**2).sum(-1)
    radius = np.sqrt(square)
    straight = radius.copy()
    for _ in range(30):
        straight = radius / (1 - 0.2 * straight**2)
    shown = 0.5 + ray[..., 0] * straight / np.maximum(radius, 1e-9)
    photo = replace(plain, image=np.repeat(shown[..., None], 3, 2).astype(np.float32))
    flat = without_lens(photo, lens)
    inner = flat.valid() & (radius < 0.4)
    assert inner.mean() > 0.5
    assert np.abs(flat.image[..., 0] - (0.5 + ray[..., 0]))[inner].max() < 0.006
    assert np.abs(photo.image[..., 0] - (0.5 + ray[..., 0]))[inner].max() > 0.008


def test_refinement_finds_the_camera_again() -> None:
    scene = textured_scene()
    camera = Camera("h000", 128, 96, 160.0, 160.0, 64, 48, arc([12], 3.0)[0])
    photo = np.clip(render(scene, camera).image, 0, 1)
    twist = np.array([0.02, -0.03, 0.03, 0.01, -0.012, 0.015])  # about two pixels each
    start = replace(camera, cam_from_world=moved_by(twist, camera.cam_from_world))
    valid = np.ones((96, 128), bool)
    valid[:, :10] = False
    spoiled = photo.copy()
    spoiled[:, :10] = 1  # what does not count must not matter
    refined = refine_camera(lambda c: render(scene, c, threads=1), spoiled, valid, start, 3.0)
    assert refined.after < 0.02 * refined.before
    between = refined.camera.rotation @ camera.rotation.T
    assert np.degrees(rotation_angle(between)) < 0.1  # of 1.2
    assert np.linalg.norm(refined.camera.centre - camera.centre) < 0.006
    again = refine_camera(lambda c: render(scene, c, threads=2), spoiled, valid, start, 3.0)
    np.testing.assert_array_equal(again.camera.cam_from_world, refined.camera.cam_from_world)


def test_normal_equations_are_those_of_the_weighted_squares() -> None:
    rng = np.random.default_rng(3)
    slopes = [rng.normal(size=(7, 9, 3)).astype(np.float32) for _ in range(3)]
    residual = rng.normal(size=(7, 9, 3)).astype(np.float32) * np.float32(0.01)
    counted = rng.random((7, 9)) < 0.6
    matrix, vector = normal_equations(slopes, residual, counted)
    errors = residual[counted].ravel().astype(np.float64)
    columns = np.stack([slope[counted].ravel() for slope in slopes], 1).astype(np.float64)
    weights = 1 / np.maximum(np.abs(errors), 0.002)
    np.testing.assert_allclose(matrix, columns.T @ (weights[:, None] * columns), rtol=1e-4)
    np.testing.assert_allclose(vector, columns.T @ (weights * errors), rtol=1e-4)


def test_refinement_keeps_the_best() -> None:
    """A photograph of something else: the camera may move, but never to a worse place."""
    scene = textured_scene()
    camera = Camera("h000", 64, 48, 80.0, 80.0, 32, 24, arc([0], 3.0)[0])
    photo = np.random.default_rng(0).uniform(size=(48, 64, 3)).astype(np.float32)
    refined = refine_camera(
        lambda c: render(scene, c, threads=1), photo, np.ones((48, 64), bool), camera, 3.0,
    )  # fmt: skip
    assert refined.after <= refined.before
    assert refined.renders < 200
