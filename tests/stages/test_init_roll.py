"""Rolled photographs: the angle, and features of the photograph turned back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from stages.init.sfm.matching.features import detect_features, turned_back
from stages.init.sfm.matching.match import match_features
from stages.init.sfm.matching.roll import find_rolls, groups, relative_roll, rolls_of_cameras
from stages.init.sfm.matching.two_view import unrolled
from tests.stages.init_scene import orbit, texture

SIZE = (200, 260)


def clockwise(gray, degrees):
    """The picture that a camera rolled the other way takes: turned clockwise on its canvas."""
    return turned_back(gray, -degrees)


def everywhere(gray):
    return np.ones(gray.shape, bool)


def silent(*_):
    pass


def test_a_quarter_turn_is_that_of_the_pixel_grid():
    gray = texture(size=(30, 40))
    turned, original_from_turned = turned_back(gray, 90)
    np.testing.assert_array_equal(turned, np.rot90(gray, 1))  # back: anticlockwise
    # The first pixel of the turned image is the last of the first row.
    first = original_from_turned[:, :2] @ (0.5, 0.5) + original_from_turned[:, 2]
    np.testing.assert_allclose(first, [39.5, 0.5])


def test_unrolled_positions_move_as_the_picture_does():
    back = unrolled(np.array([[0.0, 1.0]]), 90)  # below the corner; anticlockwise: to its right
    np.testing.assert_allclose(back, [[1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("degrees", [40.0, 90.0])
def test_a_rolled_photograph_is_noticed_and_matched(degrees):
    gray = texture(size=SIZE)
    rolled, gray_from_rolled = clockwise(gray, degrees)
    rolls = find_rolls(
        [gray, rolled], [everywhere(gray), everywhere(rolled)], [], 0.002, 1.0, 1, silent
    )
    assert rolls[0] == 0
    difference = (rolls[1] - degrees + 180) % 360 - 180
    assert abs(difference) < 5
    first = detect_features(gray, everywhere(gray), squeezes=(1.0,))
    for roll, least, most in ((0.0, 0, 0.2), (rolls[1], 0.8, 1)):
        second = detect_features(rolled, everywhere(rolled), squeezes=(1.0,), roll=roll)
        assert second.roll == roll
        found = match_features(first, second)
        places = second.positions[found[:, 1]] @ gray_from_rolled[:, :2].T + gray_from_rolled[:, 2]
        apart = np.linalg.norm(places - first.positions[found[:, 0]], axis=1)
        right = (apart < 1.5).sum() / len(first)
        assert least <= right * 2 if least else right < most
        if least:
            assert np.median(apart[apart < 3]) < 0.3


def test_linked_photographs_are_left_alone():
    grays = [texture(size=SIZE), clockwise(texture(size=SIZE), 90)[0]]
    valid = [everywhere(gray) for gray in grays]
    assert find_rolls(grays, valid, [(0, 1)], 0.002, 1.0, 1, silent) == [0.0, 0.0]


def test_strangers_have_no_roll_and_threads_change_nothing():
    grays = [texture(0, SIZE), texture(1, SIZE), clockwise(texture(0, SIZE), 60)[0]]
    valid = [everywhere(gray) for gray in grays]
    one, two = (find_rolls(grays, valid, [], 0.002, 1.0, n, silent) for n in (1, 2))
    assert one == two
    assert one[:2] == [0.0, 0.0]
    assert abs(one[2] - 60) < 5


def test_known_cameras_tell_rolls_where_links_are_missing():
    rolls = [0.0, 0.0, 90.0, 180.0]
    cameras = []
    for number, (pose, roll) in enumerate(zip(orbit([-10, 0, 10, 20]), rolls, strict=True)):
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_euler("z", roll, degrees=True).as_matrix()
        cameras.append(Camera(str(number), 200, 160, 180.0, 180.0, 100.0, 80.0, turned @ pose))
    found = np.array(rolls_of_cameras(cameras, [(0, 1)]))
    assert np.abs((found - rolls + 180) % 360 - 180).max() < 5
    assert rolls_of_cameras(cameras, [(0, 1), (1, 2), (1, 3)]) == [0.0] * 4


def test_no_matches_say_nothing():
    none = np.zeros((0, 2))
    assert relative_roll(none, none, np.zeros(0), 40.0).votes == 0


def test_groups_follow_the_links():
    assert groups([(1, 2), (2, 4)], 5) == [0, 1, 1, 3, 1]
    assert groups([], 2) == [0, 1]
