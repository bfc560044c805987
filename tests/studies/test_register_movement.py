"""How movements are put into words and numbers, without any photograph."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import RequestError
from pipeline.geometry.rigid import exponential
from pipeline.studies.register import comparing, movement
from pipeline.studies.register.geometry import first_frame
from pipeline.studies.register.uncertainty import USUAL, misfit
from pipeline.studies.register.visit import textbook_scale
from tests.studies.register_case import toy_centres


def test_half_of_the_interval_has_a_factor_and_a_floor_of_its_own_for_shifts_and_turns() -> None:
    half = comparing.halves(np.array([0.0, 0.2, 1.0, 0.0, 2.0, 3.0]), (2.0, 3.0), (0.3, 8.0, 8.0))
    assert half == pytest.approx([0.3, 0.5, np.hypot(2.0, 0.3), 8.0, 10.0, np.hypot(9.0, 8.0)])


def test_doubt_grows_as_pictures_agree_less() -> None:
    doubts = [misfit(likeness) for likeness in (0.95, USUAL, 0.6, 0.3)]
    assert doubts == sorted(doubts)
    assert doubts[1] == pytest.approx(1.0)
    assert misfit(-0.5) == misfit(0.0) < np.inf
    assert misfit(1.0) > 0


def test_first_frame_stands_up_to_teeth_that_moved() -> None:
    centres = toy_centres()
    turn = exponential(np.array([0, 0, 0, 0.4, 1.0, -0.3]))[0]
    target = {n: 0.9 * turn @ c + [5, 6, 7] for n, c in centres.items()}
    for number in (11, 12, 21, 22, 31, 32):
        target[number] = target[number] + [0, 2.5, 0]
    frame, agreeing = first_frame(centres, target)
    assert set(agreeing) == set(centres) - {11, 12, 21, 22, 31, 32}
    assert np.allclose(frame[:3, :3], 0.9 * turn, atol=1e-6)


@pytest.mark.parametrize(
    ("tooth", "way", "part"),
    [
        (11, (1, 0, 0), ("mesial", 1)),
        (21, (1, 0, 0), ("mesial", -1)),
        (11, (0, 0, 1), ("buccal", 1)),
        (15, (-1, 0, 0), ("buccal", 1)),
        (12, (0, -1, 0), ("extrusion", 1)),
        (33, (0, 1, 0), ("extrusion", 1)),
    ],
)
def test_directions_have_their_names(
    tooth: int, way: tuple[float, ...], part: tuple[str, int]
) -> None:
    axes = movement.tooth_axes(toy_centres())[tooth]
    parts = movement.to_parts(axes) @ np.array([*way, 0, 0, 0], float)
    name = movement.PARTS[int(np.argmax(np.abs(parts)))]
    assert (name, int(np.sign(parts[movement.PARTS.index(name)]))) == part


@pytest.mark.parametrize("tooth", [12, 22, 32, 42])
def test_turns_have_their_names(tooth: int) -> None:
    """The same words mean the same on both sides and in both jaws."""
    centre = toy_centres()[tooth]
    axes = movement.tooth_axes(toy_centres())[tooth]
    mesial, buccal, out_of_gum = axes
    parts = movement.to_parts(axes)
    for name, point, way in (
        ("tip", out_of_gum, mesial), ("torque", out_of_gum, buccal), ("rotation", mesial, buccal),
    ):  # fmt: skip
        value = np.zeros(6)
        value[movement.PARTS.index(name)] = 2.0
        turn = np.linalg.solve(parts, value)[3:]
        assert np.cross(turn, point) @ way > 0, (tooth, name)
    assert np.allclose(parts @ np.linalg.inv(parts), np.eye(6)), centre


def test_words_name_what_is_beyond_the_doubt() -> None:
    half = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
    said = movement.words(np.array([-0.4, 0.05, 0.2, 0.5, -3.0, 0.0]), half)
    assert said == "0.40 mm distal, 0.20 mm extrusion, torque -3.0°"
    assert "no movement" in movement.words(np.zeros(6), half)


def test_axes_need_both_sides() -> None:
    right = {n: c for n, c in toy_centres().items() if n // 10 in (1, 4)}
    with pytest.raises(ValueError, match="both sides"):
        movement.mouth_axes(right)


def test_textbook_teeth_give_a_scale() -> None:
    front = {11: np.zeros(3), 21: np.array([0, 0, 4.25]), 22: np.array([0, 3.75, 4.25])}
    assert textbook_scale(front) == pytest.approx(2.0)
    with pytest.raises(RequestError, match="neighbouring"):
        textbook_scale({11: np.zeros(3), 16: np.ones(3)})
