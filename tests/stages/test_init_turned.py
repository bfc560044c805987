"""Which photographs are taken for mirror images, and turned back: with a fit that is made up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.artifacts.views import View
from stages.dentition.corrections import says_side
from stages.dentition.crowns import mirrored_dentition
from stages.init.dental.mirror_images import Turned, fit_turned, turnings
from stages.init.dental.solution import ArchFit, PlacedView

WIDTH, HEIGHT = 60, 20
SIDES = ("right", "frontal", "left")
NAMES = ("0_right.jpg", "1.jpg", "2_Left.jpg")
NAMELESS = ("a.jpg", "b.jpg", "c.jpg")


def view(number: int) -> View:
    ramp = np.linspace(0, 1, WIDTH, dtype=np.float32) / (number + 1)
    image = np.broadcast_to(ramp[None, :, None], (HEIGHT, WIDTH, 3)).copy()
    return View(f"{number:03d}", image)


def dentition(number: int, tooth: int = 0, doubt: float = 1.0) -> Dentition:
    """One crown near the left border."""
    corners = np.array([[5.0, 5], [11, 5], [11, 15], [5, 15]])
    crown = Crown(
        "upper", corners[0], corners[2], None, None, None, None, 6, 10, outline=corners,
        number=tooth, doubt=doubt,
    )  # fmt: skip
    return Dentition(f"{number:03d}", (WIDTH, HEIGHT), "front", (crown,))


def found(
    roles: Sequence[str] = SIDES, mirrored: Iterable[int] = (), doubts: tuple[str, ...] = ("odd",),
    confidence: float = 0.3,
) -> ArchFit:  # fmt: skip
    """What a fit says of photographs with these roles; "": it was not placed."""
    views = tuple(
        PlacedView(np.eye(4), 100.0, role, (11,), (), 0.5) if role else None for role in roles
    )
    return ArchFit(views, {}, {}, 9.0, doubts, mirrored=tuple(mirrored), confidence=confidence)


class Fit:
    """Doubts all but some sets of photographs turned over."""

    def __init__(self, first: ArchFit, good: dict[tuple[int, ...], float]) -> None:
        self.first, self.good = first, good
        self.asked: list[tuple[int, ...]] = []

    def __call__(self, views: list[View], dentitions: list[Dentition | None]) -> ArchFit:
        over = tuple(k for k, seen in enumerate(views) if seen.image[0, 0, 0] > 0)
        for k, (seen, teeth) in enumerate(zip(views, dentitions, strict=True)):
            if teeth is not None:  # picture and crowns are turned together
                assert seen.name == teeth.name
                at_left = teeth.upper[0].outline[:, 0].max() < WIDTH / 2
                assert at_left == (k not in over)
        self.asked.append(over)
        if not over:
            return self.first
        if over in self.good:
            return found(doubts=(), confidence=self.good[over])
        return found(confidence=0.49)


def turned(
    fit: Fit, names: Sequence[str] = NAMES, dentitions: list[Dentition | None] | None = None
) -> Turned:
    given = dentitions or [dentition(k) for k in range(len(names))]
    views = [view(k) for k in range(len(names))]
    result = fit_turned(views, given, names, fit)
    for k, (before, after) in enumerate(zip(views, result.views, strict=True)):
        over = k in result.mirrored
        np.testing.assert_array_equal(after.image, before.image[:, ::-1] if over else before.image)
        assert (result.dentitions[k] is given[k]) != over
        teeth = result.dentitions[k]
        if over and teeth:
            assert teeth.mirrored is True
    if not result.mirrored:
        assert result.fit is fit.first
    return result


def test_what_is_not_doubtful_is_not_tried_again() -> None:
    fit = Fit(found(mirrored=(1,), doubts=(), confidence=0.6), {(1,): 0.9})
    assert turned(fit).mirrored == ()
    assert fit.asked == [()]


def test_a_mirrored_front_is_turned_back_where_names_tell_the_sides() -> None:
    fit = Fit(found(mirrored=(1,)), {(1,): 0.9})
    result = turned(fit)
    assert result.mirrored == (1,)
    assert (result.fit.doubts, result.fit.confidence) == ((), 0.9)
    assert fit.asked == [(), (1,)]


def test_mirrored_sides_are_turned_back_where_names_tell_them() -> None:
    fit = Fit(found(("left", "frontal", "right"), mirrored=(1,)), {(0, 2): 0.9, (1,): 0.9})
    assert turned(fit).mirrored == (0, 2)
    assert fit.asked == [(), (0, 2)], "the front fits the sides' mirror image as well"


def test_of_two_photographs_none_is_turned_back() -> None:
    fit = Fit(found(("right", "frontal"), mirrored=(1,)), {(1,): 0.9})
    assert turned(fit, NAMES[:2]).mirrored == ()
    assert fit.asked == [()]


def test_names_that_say_nothing_leave_it_open_which_is_mirrored() -> None:
    fit = Fit(found(mirrored=(1,)), {(1,): 0.9, (0, 2): 0.9})
    assert turned(fit, NAMELESS).mirrored == ()
    assert fit.asked == [()]


def test_one_mirrored_side_is_found_by_its_name() -> None:
    fit = Fit(found(("right", "frontal", "right")), {(0,): 0.9, (2,): 0.9})
    assert turned(fit).mirrored == (2,)
    assert fit.asked == [(), (2,)]


def test_one_mirrored_side_is_found_by_trying_both() -> None:
    fit = Fit(found(("right", "frontal", "right")), {(2,): 0.9})
    assert turned(fit, NAMELESS).mirrored == (2,)
    assert fit.asked == [(), (0,), (2,)]


def test_two_ways_that_are_good_are_none() -> None:
    fit = Fit(found(("right", "frontal", "right")), {(0,): 0.9, (2,): 0.7})
    assert turned(fit, NAMELESS).mirrored == ()
    assert fit.asked == [(), (0,), (2,)]


@pytest.mark.parametrize(
    "good", [pytest.param({}, id="still doubtful"), pytest.param({(1,): 0.25}, id="no surer")]
)
def test_what_is_no_better_turned_over_stays(good: dict[tuple[int, ...], float]) -> None:
    fit = Fit(found(mirrored=(1,), confidence=0.3), good)
    assert turned(fit).mirrored == ()
    assert fit.asked == [(), (1,)]


@pytest.mark.parametrize(
    ("said", "mirrored"),
    [
        (replace(dentition(1), mirrored=False), ()),
        (mirrored_dentition(dentition(1)), ()),
        (dentition(1, tooth=12, doubt=0.0), ()),
        (dentition(1, tooth=12, doubt=0.001), (1,)),
        (dentition(1, doubt=0.0), (1,)),
    ],
    ids=["no mirror image", "mirror image", "a number", "a sure number", "no number"],
)
def test_what_a_person_has_said_is_not_turned(said: Dentition, mirrored: tuple[int, ...]) -> None:
    fit = Fit(found(mirrored=(1,)), {(1,): 0.9})
    given = [dentition(0), said, dentition(2)]
    views = [view(k) for k in range(3)]
    result = fit_turned(views, list(given), NAMES, lambda shown, _: fit(shown, [None] * 3))
    assert result.mirrored == mirrored


def test_nor_is_a_set_with_such_a_photograph() -> None:
    roles = ("left", "frontal", "right")
    said = replace(dentition(2), mirrored=False)
    fit = Fit(found(roles, mirrored=(1,)), {(0, 2): 0.9, (0,): 0.9})
    assert turned(fit, dentitions=[dentition(0), dentition(1), said]).mirrored == ()
    fit = Fit(found(roles, mirrored=(1,)), {(0, 2): 0.9})
    front = replace(dentition(1), mirrored=False)
    assert turned(fit, dentitions=[dentition(0), front, dentition(2)]).mirrored == (0, 2)


def test_photographs_that_take_no_part_stay() -> None:
    fit = Fit(found(("right", "frontal", "left", ""), mirrored=(1,)), {(1,): 0.9})
    teeth = [dentition(0), dentition(1), dentition(2), None]
    assert turned(fit, (*NAMES, "3_left.jpg"), teeth).mirrored == (1,)


@pytest.mark.parametrize(
    ("roles", "mirrored", "names", "expected"),
    [
        # A front that fits the sides better turned over: one name is enough, two must agree.
        ("right frontal left", (1,), "right.jpg b.jpg c.jpg", [(1,)]),
        ("right frontal left", (1,), "left.jpg b.jpg c.jpg", [(0, 2)]),
        ("right frontal left", (1,), "left.jpg b.jpg left2.jpg", []),
        ("right frontal left", (1,), "a.jpg right.jpg c.jpg", []),
        ("right frontal left", (), "left.jpg b.jpg right.jpg", []),
        ("right frontal frontal left", (1, 2), "right.jpg b c left.jpg", [(1, 2)]),
        ("right frontal frontal left", (1, 2), "left.jpg b c right.jpg", [(0, 3)]),
        ("right frontal", (1,), "right.jpg b.jpg", []),
        ("right frontal", (1,), "left.jpg b.jpg", [(0,)]),
        # All of one side: one may be the other side's mirror image, whatever the front says.
        ("right frontal right", (), "a.jpg b.jpg c.jpg", [(0,), (2,)]),
        ("right frontal right", (1,), "a.jpg b.jpg c.jpg", [(0,), (2,)]),
        ("left frontal left", (), "right.jpg b.jpg c.jpg", [(0,)]),
        ("left frontal left", (), "left.jpg b.jpg c.jpg", [(2,)]),
        ("left frontal left", (), "left.jpg b.jpg left2.jpg", []),
        ("left frontal left", (), "right.jpg b.jpg right2.jpg", [(0,), (2,)]),
        # Not placed, or none of a side.
        ("right - left", (), "right.jpg b.jpg left.jpg", []),
        ("frontal frontal -", (), "right.jpg b.jpg left.jpg", []),
    ],
)
def test_which_photographs_may_be_mirror_images(
    roles: str, mirrored: tuple[int, ...], names: str, expected: list[tuple[int, ...]]
) -> None:
    fit = found([role.strip("-") for role in roles.split()], mirrored)
    assert turnings(fit, names.split()) == expected


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("0_right.jpg", "right"),
        ("IMG Left 3.JPG", "left"),
        ("LEFT.png", "left"),
        ("left-right.jpg", ""),
        ("buccalRight2.jpg", "right"),
        ("rightBuccal.jpg", "right"),
        ("IMG_1.right.jpg", "right"),
        ("wright_3.jpg", ""),
        ("Wright-left.jpg", "left"),
        ("CARTWRIGHT 1.JPG", ""),
        ("cleft_lip.jpg", ""),
        ("McCleft right.jpg", "right"),
        ("p0.jpg", ""),
        ("", ""),
    ],
)
def test_sides_in_names(name: str, side: str) -> None:
    assert says_side(name) == side
