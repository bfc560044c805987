"""Teeth before cameras that are known: the cameras hold still, the arch finds its place."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.geometry.order import neighbour_angle
from stages.init.dental.cameras.bundle import CameraPriors, Sightings, adjust
from stages.init.dental.cameras.centred import centre_view
from stages.init.dental.cameras.held import HeldCameras, nearest_similarity
from stages.init.dental.numbering.arch import fit_arch
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.surface.chart.jaws import Chart
from stages.init.dental.surface.grow import go_on_straight
from stages.init.dental.template import textbook_arch
from tests.stages import dental_patient
from tests.stages.dental_surface_case import row_of_teeth

WORLD_UNIT = 0.07  # of the known cameras' world per mm
TURN = Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix()
SHIFT = np.array([3.0, -1.0, 0.5])


def in_world(pose: np.ndarray) -> np.ndarray:
    """A camera of the arch frame (mm) in another world and unit: X_world = u R X + s."""
    moved = np.eye(4)
    moved[:3, :3] = pose[:3, :3] @ TURN.T
    moved[:3, 3] = WORLD_UNIT * pose[:3, 3] - moved[:3, :3] @ SHIFT
    return moved


def pose_at(yaw: float) -> np.ndarray:
    """A camera of the arch frame."""
    return dental_patient.photograph(dental_patient.patient(1), yaw)[1]


def relative(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    motion = b @ np.linalg.inv(a)
    return motion[:3, :3], motion[:3, 3]


def problem(offset: float = 0.0):
    """Cameras of the arch frame, all landmarks as they see them, priors."""
    rng = np.random.default_rng(3)
    arch = textbook_arch() * [1.05, 1, 0.95] + offset * rng.normal(size=textbook_arch().shape)
    poses = [pose_at(yaw) for yaw in (-41.0, 3.0, 44.0)]
    view, landmark, pixels = [], [], []
    for number, pose in enumerate(poses):
        local = arch @ pose[:3, :3].T + pose[:3, 3]
        for index in range(0, len(arch), 2):
            view.append(number)
            landmark.append(index)
            pixels.append(900 * local[index, :2] / local[index, 2])
    sightings = Sightings(
        np.array(view), np.array(landmark), np.array(pixels), np.full((len(view), 2), 1.0)
    )
    priors = CameraPriors(
        yaws=np.array([-42.0, 0, 42]), angle_deviations=np.full((3, 3), 8.0), elevation=4.0,
        distance=125.0, distance_deviation=0.5, focals=np.full(3, 900.0),
        focal_deviations=np.zeros(3),
    )  # fmt: skip
    return poses, sightings, priors, arch


def held(poses) -> HeldCameras:
    world = [in_world(pose) for pose in poses]
    return HeldCameras(np.stack([w[:3, :3] for w in world]), np.stack([w[:3, 3] for w in world]))


def test_known_cameras_are_held_exactly_and_the_arch_is_found_in_any_world() -> None:
    poses, sightings, priors, arch = problem()
    found = adjust(sightings, textbook_arch(), priors, 1.2, held=held(poses))
    free = adjust(sightings, textbook_arch(), priors, 1.2)
    units = []
    for other in (1, 2):
        turn, shift = relative(poses[0], poses[other])
        ours = found.rotations[other] @ found.rotations[0].T
        np.testing.assert_allclose(ours, turn, atol=1e-9)
        moved = found.translations[other] - ours @ found.translations[0]
        units.append(np.linalg.norm(moved) / np.linalg.norm(shift))
        np.testing.assert_allclose(moved / units[-1], shift, atol=1e-6)
    assert units[0] == pytest.approx(units[1], rel=1e-9)  # one similarity for all
    seen = np.unique(sightings.landmark)
    for view in range(3):
        mine = sightings.view == view
        seen_here = found.project(view, found.points[sightings.landmark[mine]])
        assert np.abs(seen_here - sightings.pixels[mine]).max() < 1.0
    assert np.linalg.norm(found.points[seen] - arch[seen], axis=1).mean() < 1.0
    assert found.held
    assert found.reduced.shape == (16, 16)
    assert not free.held
    assert not np.allclose(
        free.rotations[1] @ free.rotations[0].T, relative(*poses[:2])[0], atol=1e-5
    )


def test_held_gradient_vanishes_at_the_solution() -> None:
    """No small motion of the arch before the cameras is better than what was found."""
    poses, sightings, priors, _ = problem(offset=0.5)
    cameras = held(poses)
    best = adjust(sightings, textbook_arch(), priors, 1.2, held=cameras, tolerance=1e-9)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        start = best.unknowns + 0.02 * rng.normal(size=best.unknowns.shape)
        again = adjust(
            sightings, textbook_arch(), priors, 1.2, held=cameras,
            start=(start, best.offsets), max_steps=0,
        )  # fmt: skip
        assert again.cost > best.cost
        solved = adjust(
            sightings, textbook_arch(), priors, 1.2, held=cameras,
            start=(start, best.offsets), tolerance=1e-9,
        )  # fmt: skip
        assert solved.cost == pytest.approx(best.cost, abs=1e-4)


def test_nearest_similarity_undoes_a_change_of_world() -> None:
    poses, *_ = problem()
    turns, shifts = held(poses).from_first()
    centre = np.array([0.0, 0, -16])
    rotations = np.stack([pose[:3, :3] for pose in poses])
    centres = np.stack([pose[:3, :3] @ centre + pose[:3, 3] for pose in poses])
    rotation, place, log_scale = nearest_similarity(rotations, centres, turns, shifts)
    np.testing.assert_allclose(rotation, rotations[0], atol=1e-9)
    np.testing.assert_allclose(place, centres[0], atol=1e-8)
    for view in range(3):
        at = turns[view] @ place + np.exp(log_scale) * shifts[view]
        np.testing.assert_allclose(at, centres[view], atol=1e-8)


def test_teeth_are_named_before_known_cameras_whatever_their_world() -> None:
    dentitions, poses, teeth = dental_patient.three(rolls=(0, 0.07, -0.05))
    images = [np.full((*d.mask.shape, 3), 0.5, np.float32) for d in dentitions]
    result = fit_arch(
        dentitions, images, [np.ones(d.mask.shape, bool) for d in dentitions],
        [950.0] * 3, ArchOptions(dense_rounds=0, rows_tried=8), 1, lambda *_: None,
        cameras=[in_world(pose) for pose in poses],
    )  # fmt: skip
    assert dental_patient.rotation_errors(result, poses) == pytest.approx([0, 0], abs=1e-4)
    assert [(view.upper, view.lower) for view in result.views] == teeth
    assert [view.role for view in result.views] == ["right", "frontal", "left"]


def test_centred_photograph_has_its_principal_point_in_the_middle_and_maps_come_back() -> None:
    image = np.random.default_rng(0).random((60, 90, 3)).astype(np.float32)
    camera = Camera("000", 90, 60, 120.0, 100.0, 40.0, 35.5, np.eye(4))
    centred = centre_view(View("000", image), camera)
    height, width = centred.view.image.shape[:2]
    assert (width, height) == (100, 86)  # nothing is cut off; 1.2 times as high
    assert centred.point(40.0, 35.5) == (width / 2, height / 2)
    ray = ((10 - 40.0) / 120, (50 - 35.5) / 100)
    moved = centred.point(10, 50)
    assert (moved[0] - width / 2) / centred.focal == pytest.approx(ray[0])
    assert (moved[1] - height / 2) / centred.focal == pytest.approx(ray[1])
    assert not centred.view.valid().all()
    y, x = np.mgrid[:height, :width] + 0.5
    back = centred.back(np.stack([x, y], -1).astype(np.float32), 90, 60)
    u, v = np.meshgrid(np.arange(90) + 0.5, np.arange(60) + 0.5)
    there = np.stack(
        [u + centred.centred_from_view[0, 2], 1.2 * v + centred.centred_from_view[1, 2]], -1
    )
    assert np.abs(back - there).max() <= 0.5 + 1e-5
    same = View("000", image)
    usual = centre_view(same, Camera("000", 90, 60, 120.0, 120.0, 45.0, 30.0, np.eye(4)))
    assert usual.view is same


def test_angle_between_neighbouring_cameras() -> None:
    def cameras(yaws):
        return [Camera(str(yaw), 100, 80, 100, 100, 50, 40, in_world(pose_at(yaw))) for yaw in yaws]

    assert neighbour_angle(cameras((-40, 0, 35))) == pytest.approx(35, abs=1.5)
    assert neighbour_angle(cameras((-40, -30, 0, 35))) == pytest.approx(20, abs=3)
    assert neighbour_angle(cameras((0,))) == 0
    straight = [Camera("a", 9, 9, 9, 9, 4, 4, np.eye(4)) for _ in range(2)]
    assert neighbour_angle(straight) == 0


def test_gum_goes_on_with_the_slope_that_it_has() -> None:
    chart = grown_chart()
    up = chart.grid.heights[:, None] > 0
    before = chart.radius.copy()
    go_on_straight(chart, 4.0)
    gum = gum_of(chart)
    beyond = (gum > 5) & up
    # The wall leaned outwards by .3 per mm up to there: so it goes on.
    slope = np.diff(chart.radius, axis=0)[beyond[1:]] * chart.grid.density
    assert np.median(slope) == pytest.approx(-0.3, abs=0.02)
    np.testing.assert_array_equal(chart.radius[gum <= 4], before[gum <= 4])


def gum_of(chart: Chart) -> np.ndarray:
    from stages.init.dental.surface.chart.crown_shape import beyond_crowns

    return beyond_crowns(chart.grid, chart.shape)[0]


def grown_chart() -> Chart:
    """An upper jaw whose gum leans outwards 4 mm beyond the gum line; further up it is wrong."""
    from stages.init.dental.surface.chart.crown_shape import jaw_shape
    from stages.init.dental.surface.chart.grid import ChartGrid

    marks = row_of_teeth()
    shape = jaw_shape("upper", marks, {mark.tooth for mark in marks}, set())
    assert shape is not None
    chart = Chart(shape, ChartGrid(-15.0, 25.0, 4.0, (120, 121)), np.zeros((120, 121)), np.zeros(1))
    gum = gum_of(chart)
    wall = np.float32(28) + 0.3 * np.maximum(gum, 0)
    chart.radius = np.where(gum < 4.5, wall, 20).astype(np.float32)
    return chart
