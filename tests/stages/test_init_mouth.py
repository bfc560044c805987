"""The frame of a mouth, from teeth whose places are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import ALL_TEETH, other_side
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View
from stages.init.dental.template import landmark_names, textbook_arch
from stages.init.mouth import mouth_frame, primary_places, textbook_scale, tooth_places


def textbook():
    """Edges and necks of a textbook mouth (x to the left, y up, z to the front; mm)."""
    arch = textbook_arch()
    return {
        (name.kind, name.tooth): place
        for name, place in zip(landmark_names(), arch, strict=True)
        if name.kind in ("tip", "zenith")
    }


def moved(places, frame):
    return {key: frame[:3, :3] @ place + frame[:3, 3] for key, place in places.items()}


@pytest.fixture
def somewhere():
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("xyz", [170, 25, -50], degrees=True).as_matrix()
    frame[:3, 3] = [3, -2, 8]
    return frame


def angle(rotation) -> float:
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def test_a_textbook_mouth_stands_as_it_is_drawn() -> None:
    frame = mouth_frame(textbook())
    # The textbook's upper row rises by a mm to the back: the plane leans with it.
    assert angle(frame[:3, :3]) < 3
    edges = (textbook()["tip", 11] + textbook()["tip", 21]) / 2
    origin = np.linalg.inv(frame)[:3, 3]
    assert abs(origin[0]) < 1e-9 and np.linalg.norm(origin - edges) < 1


@pytest.mark.parametrize("lost", [(), (11,), (16, 17, 27), (12, 13, 14, 15)])
def test_it_goes_with_the_mouth_and_bears_noise_and_gaps(somewhere, lost) -> None:
    before = mouth_frame(textbook())
    random = np.random.default_rng(4)
    places = {
        key: place + random.normal(0, 0.3, 3)
        for key, place in moved(textbook(), somewhere).items()
        if key[1] not in lost
    }
    found = mouth_frame(places) @ somewhere @ np.linalg.inv(before)
    assert angle(found[:3, :3]) < 2.5
    if 11 not in lost:
        assert np.linalg.norm(found[:3, 3]) < 0.8


def test_one_tooth_far_off_changes_little(somewhere) -> None:
    places = moved(textbook(), somewhere)
    before = mouth_frame(places)
    up = before[1, :3]
    places["tip", 16] = places["tip", 16] + 6 * up
    turned = mouth_frame(places)[:3, :3] @ before[:3, :3].T
    assert angle(turned) < 1.5


def test_what_tells_no_frame_is_left_alone() -> None:
    arch = textbook()
    front = {key: place for key, place in arch.items() if key[1] % 10 <= 2}
    assert mouth_frame(front) is None, "four front teeth stand in a line"
    right = {key: place for key, place in arch.items() if key[1] // 10 in (1, 4)}
    assert mouth_frame(right) is None, "one side"
    assert mouth_frame({}) is None
    mirrored = {(kind, other_side(tooth)): place for (kind, tooth), place in arch.items()}
    found = mouth_frame(mirrored)
    assert found is None, "with the sides mixed up the front teeth would be at the back"


def test_lower_teeth_serve_where_upper_ones_are_not_seen() -> None:
    lower = {key: place for key, place in textbook().items() if key[1] > 30}
    assert angle(mouth_frame(lower)[:3, :3]) < 8


def test_teeth_are_found_in_space_by_their_pixels() -> None:
    """A tilted plane in front of a camera; crowns of which one is doubtful, one is primary."""
    camera = Camera("000", 80, 60, 100, 100, 40, 30, np.eye(4))
    row = np.mgrid[:60, :80][0] + 0.5
    depth = (5 + row / 30).astype(np.float32)

    def crown(number, x, doubt=0.1):
        zenith, tip = np.array([x, 20.0]), np.array([x, 80.0])
        return Crown(
            "upper", zenith, tip, None, None, None, None, 10, 60, number=number, doubt=doubt
        )

    read = Dentition(
        "000", (160, 120), "front", (crown(51, 60.0), crown(21, 100.0), crown(22, 130.0, 0.9))
    )
    view = View("000", np.zeros((60, 80, 3), np.float32))
    places = tooth_places(Teeth((read,)), [view], [camera], [depth])
    assert set(places) == {(k, t) for k in ("tip", "zenith") for t in (11, 21)}
    pixel, z = camera.project(places["tip", 11][None])
    np.testing.assert_allclose(pixel[0], [30, 40], atol=1e-6)
    assert z[0] == pytest.approx(5 + 34 / 30, abs=0.03), "the depth of a fifth of the way up"
    nothing = tooth_places(Teeth((read,)), [view], [camera], [0 * depth])
    assert nothing == {}


def test_textbook_teeth_tell_millimetres(somewhere) -> None:
    """The places of a textbook mouth at a tenth of its size, with noise, gaps and one tooth off."""
    random = np.random.default_rng(2)
    places = {
        key: (place + random.normal(0, 0.3, 3)) / 10
        for key, place in moved(textbook(), somewhere).items()
        if key[1] not in (14, 36)
    }
    places["tip", 23] = places["tip", 23] + 0.5
    factor, deviation = textbook_scale(places)
    assert factor == pytest.approx(10, rel=0.06)
    assert 0.1 <= deviation < 0.13


def test_primary_teeth_tell_millimetres_by_their_own_widths() -> None:
    primary = frozenset(tooth for tooth in ALL_TEETH if tooth < 50 and tooth % 10 < 6)
    arch = textbook_arch(frozenset(), primary)
    names = landmark_names()
    places = {
        (mark.kind, mark.tooth): arch[k] / 10
        for k, mark in enumerate(names) if mark.kind == "tip" and mark.tooth in primary
    }  # fmt: skip
    by_primary = textbook_scale(places, primary)[0]
    assert by_primary == pytest.approx(10, rel=0.08)
    assert textbook_scale(places)[0] > 1.1 * by_primary, "taken for permanent teeth"


def test_one_primary_tooth_in_a_few_photographs_is_not_a_childs_mouth() -> None:
    def read(numbers: dict[int, float]) -> Dentition:
        at = np.zeros(2)
        crowns = [
            Crown("upper", at, at, None, None, None, None, 10, 60, number=number, doubt=doubt)
            for number, doubt in numbers.items()
        ]
        return Dentition("", (160, 120), "front", tuple(crowns))

    frames = ({55: 0.1, 14: 0.1}, {15: 0.1, 54: 0.9}, {15: 0.1}, {74: 0.1})
    assert primary_places(Teeth(tuple(map(read, frames)))) == {34}


def test_a_few_teeth_tell_no_scale() -> None:
    few = {key: place for key, place in textbook().items() if key[1] in (11, 12, 21, 22, 41, 31)}
    assert textbook_scale(few) is None
