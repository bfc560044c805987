"""Similarities, the cameras' arrangement, and paths between them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.views import Views
from stages.export.pictures.orbits import (
    between,
    central_depth,
    find_orbit,
    look_at,
    there_and_back,
    widened,
)
from stages.export.scene import assemble
from stages.splatting.frame import (
    harmonics,
    harmonics_rotation,
    move_cameras,
    move_gaussians,
    move_points,
    split_similarity,
)
from stages.splatting.rendering import render
from tests.stages import export_scene as scene


def similarity(scale: float = 23.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    matrix[:3, 3] = [5.0, -40.0, 12.0]
    return matrix


@pytest.mark.parametrize("lit", [False, True])
def test_a_moved_scene_looks_the_same_to_moved_cameras(lit: bool) -> None:
    gaussians = scene.lit_ball() if lit else scene.ball_gaussians(degree=3)
    camera = scene.ball_cameras()[0]
    before = render(gaussians, camera)
    (moved_camera,) = move_cameras([camera], similarity())
    after = render(move_gaussians(gaussians, similarity()), moved_camera)
    assert before.alpha.max() > 0.9
    # single pixels differ by more where rounding decides about the 1/255 cut
    assert np.abs(after.image - before.image).mean() < 1e-4
    assert np.abs(after.image - before.image).max() < 0.02
    solid = before.alpha > 0.5
    np.testing.assert_allclose(after.depth[solid], 23.0 * before.depth[solid], rtol=1e-3)


def test_moving_keeps_degrees_that_are_not_used_at_zero() -> None:
    moved = move_gaussians(scene.ball_gaussians(degree=1), similarity())
    assert moved.sh[:, 1:4].any()
    assert not moved.sh[:, 4:].any()


def test_points_move_with_the_cameras() -> None:
    camera, points = scene.ball_cameras()[2], scene.ball_points()
    (moved,) = move_cameras([camera], similarity())
    there = move_points(points, similarity())
    np.testing.assert_allclose(
        moved.project(there.positions)[0], camera.project(points.positions)[0], atol=1e-3
    )
    np.testing.assert_allclose(np.linalg.norm(there.normals, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(there.scale, 23 * points.scale, rtol=1e-5)


def test_rotated_harmonics_are_the_harmonics_of_rotated_directions() -> None:
    random = np.random.default_rng(0)
    directions = random.standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    coefficients = random.standard_normal(16)
    rotation = Rotation.from_rotvec([0.3, 2.0, -0.5]).as_matrix()
    turned = harmonics_rotation(rotation) @ coefficients
    np.testing.assert_allclose(
        harmonics(directions @ rotation.T) @ turned, harmonics(directions) @ coefficients, atol=1e-9
    )


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 1, -1, 1]), np.diag([1.0, 2, 1, 1]), np.diag([0.0, 0, 0, 1])]
)
def test_what_is_no_similarity_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a similarity"):
        split_similarity(matrix)


def test_the_orbit_is_found() -> None:
    cameras = scene.ball_cameras()
    depths = []
    for camera in cameras:
        view = render(scene.ball_gaussians(), camera)
        depths.append(central_depth(view.depth, view.alpha))
    assert all(2.9 < depth < 3.6 for depth in depths if depth)
    orbit = find_orbit(cameras, [4.0, 4.0, None])
    np.testing.assert_allclose(orbit.up, [0, -1, 0], atol=0.02)
    assert np.linalg.norm(orbit.centre) < 0.2
    np.testing.assert_allclose(np.abs(np.degrees(orbit.azimuths)), [35, 0, 35], atol=3)
    assert orbit.azimuths[0] * orbit.azimuths[2] < 0
    assert orbit.middle() == 1
    np.testing.assert_allclose(np.cross(orbit.up, orbit.front) @ orbit.side, 1)


def test_photographs_held_askew_are_walked_around_upright() -> None:
    askew = []
    tilt = np.eye(4)
    tilt[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    for camera in scene.ball_cameras():
        askew.append(replace(camera, cam_from_world=tilt @ camera.cam_from_world))
    upwards = np.array([0, -1.0, 0])
    assert find_orbit(askew, [3.0] * 3).up @ upwards < np.cos(0.2)
    orbit = find_orbit(askew, [3.0] * 3, upwards)
    np.testing.assert_allclose(orbit.up, upwards)
    places, _ = there_and_back(orbit, askew, (64, 48), 20, 0.0)
    for place in places:
        assert abs(place.rotation[0] @ upwards) < 1e-9, "level"


def test_look_at_keeps_up_upwards_and_does_not_mirror() -> None:
    pose = look_at(np.array([3.0, -1, 2]), np.array([0.5, 0, 0]), np.array([0, -1.0, 0]))
    camera = Camera("", 100, 100, 100, 100, 50, 50, pose)
    pixels, depth = camera.project(np.array([[0.5, 0, 0], [0.5, -0.3, 0]]))
    np.testing.assert_allclose(pixels[0], [50, 50])
    assert depth[0] > 0
    assert pixels[1, 1] < 50, "what is above must be drawn above"
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_the_path_passes_through_the_cameras_and_loops_smoothly() -> None:
    cameras = scene.ball_cameras()
    orbit = find_orbit(cameras, [3.0] * 3)
    places, place_of_frame = there_and_back(orbit, cameras, (64, 48), 200, 0.0)
    assert len(places) == 101 and place_of_frame[0] == 50, "from the middle, and back as there"
    path = [places[index] for index in place_of_frame]
    eyes = np.stack([camera.centre for camera in path])
    for camera in cameras:
        nearest = np.linalg.norm(eyes - camera.centre, axis=1).argmin()
        assert np.linalg.norm(eyes[nearest] - camera.centre) < 0.05
        assert path[nearest].rotation[2] @ camera.rotation[2] > np.cos(np.radians(1.5))
    steps = np.linalg.norm(np.diff(eyes, axis=0, append=eyes[:1]), axis=1)
    assert steps.max() < 2.5 * np.median(steps)
    assert all((camera.width, camera.height) == (64, 48) for camera in path)


def test_widened_cameras_hold_what_reached_beyond_the_picture() -> None:
    cameras = scene.ball_cameras()
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1.6, 0.4, 0.4]
    reach = [np.abs(c.project(points)[0] - (c.cx, c.cy)) / (c.width / 2) for c in cameras]
    assert max(r[:, 0].max() for r in reach) > 1, "else nothing would be tested"
    wide = widened(cameras, points)
    for camera, before in zip(wide, cameras, strict=True):
        pixels, _ = camera.project(points)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        assert inside.mean() > 0.999
        np.testing.assert_array_equal(camera.cam_from_world, before.cam_from_world)
        assert camera.fx / before.fx == pytest.approx(wide[0].fx / cameras[0].fx)


def test_cameras_that_hold_everything_stay_as_they_are() -> None:
    cameras = list(scene.ball_cameras())
    assert widened(cameras, np.zeros((4, 3)) + cameras[0].rotation[0] * 0.01) == cameras


def test_the_preview_holds_the_mouth_as_a_whole() -> None:
    """Seen from between close photographs, which do not hold it; what goes on behind is cut."""
    case = scene.ball_case()
    near = [replace(camera, fx=2 * camera.fx, fy=2 * camera.fy) for camera in scene.ball_cameras()]
    mask = np.ones((scene.HEIGHT, scene.WIDTH), bool)
    for masked in (False, True):
        views = [replace(v, mask=mask if masked else None) for v in case["views"].views[:3]]
        made = assemble(
            Views(tuple(views)), Cameras(tuple(near)), case["gaussians"], None,
            Frame("world", np.eye(4)), 1, lambda *_: None,
        )  # fmt: skip
        novel = made.novel_camera(near[1])
        pixels, _ = novel.project(case["gaussians"].means)
        inside = (pixels >= 0).all(1) & (pixels < (scene.WIDTH, scene.HEIGHT)).all(1)
        assert (inside.mean() > 0.999) == masked
        assert (novel.fx == near[1].fx) == (not masked)


def test_a_path_through_many_shaky_cameras_is_smooth() -> None:
    random = np.random.default_rng(1)
    cameras = []
    for degrees in np.linspace(-50, 50, 24):
        a = np.radians(degrees)
        eye = 4 * np.array([np.sin(a), 0, -np.cos(a)]) + 0.1 * random.standard_normal(3)
        pose = look_at(eye, 0.1 * random.standard_normal(3), np.array([0, -1.0, 0]))
        cameras.append(Camera("", 64, 48, 60, 60, 32, 24, pose))
    orbit = find_orbit(cameras, [4.0] * 24)
    eyes = np.stack([camera.centre for camera in between(orbit, cameras, 101)])
    bend = np.linalg.norm(np.diff(eyes, 2, axis=0), axis=1)
    assert bend.max() < 0.02
    assert np.linalg.norm(eyes - orbit.centre, axis=1) == pytest.approx(4, abs=0.2)


def test_one_place_of_the_path_is_its_middle() -> None:
    cameras = scene.ball_cameras()
    orbit = find_orbit(cameras, [4.0] * 3)
    (one,), (_, middle, _) = (between(orbit, cameras, count) for count in (1, 3))
    assert np.allclose(one.cam_from_world, middle.cam_from_world)


def test_a_single_camera_still_gets_a_small_orbit() -> None:
    (camera,) = scene.ball_cameras()[1:2]
    orbit = find_orbit([camera], [None])
    path, _ = there_and_back(orbit, [camera], (64, 48), 20, 0.03)
    eyes = np.stack([camera.centre for camera in path])
    assert 0.1 < np.ptp(eyes[:, 0]) < 2
    assert np.isfinite(eyes).all()
