"""Which photographs are left out because the others agree without them: with a fit made up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.artifacts.views import View
from stages.init.dental.mirror_images import Turned
from stages.init.dental.odd_ones import FEWEST, MOST, without_odd_ones
from stages.init.dental.solution import ArchFit

Doubts = Callable[[frozenset[int]], int]


def dentition(number: int, tooth: int = 0) -> Dentition:
    corners = np.array([[5.0, 5], [11, 5], [11, 15], [5, 15]])
    crown = Crown(
        "upper", corners[0], corners[2], None, None, None, None, 6, 10, outline=corners,
        number=tooth, doubt=0.0 if tooth else 1.0,
    )  # fmt: skip
    return Dentition(f"{number:03d}", (60, 20), "front", (crown,))


def left_out(
    count: int, doubts: Doubts, kept: tuple[int, ...] = (), said: tuple[int, ...] = (),
    sure: dict[frozenset[int], float] | None = None,
) -> tuple[tuple[int, ...], list[frozenset[int]]]:  # fmt: skip
    """Which of so many photographs are left out, and which sets were tried.

    Args:
        doubts: photographs that take part -> how many doubts there are about them.
        said: photographs of which a person has numbered a tooth.
        sure: photographs that take part -> confidence.
    """
    asked: list[frozenset[int]] = []

    def fit(views: list[View], dentitions: list[Dentition | None]) -> ArchFit:
        there = frozenset(k for k, seen in enumerate(dentitions) if seen is not None)
        asked.append(there)
        names = tuple(f"doubt {k}" for k in range(doubts(there)))
        confidence = (sure or {}).get(there, 0.3)
        return ArchFit((None,) * len(views), {}, {}, 0.0, names, confidence=confidence)

    views = [View(f"{k:03d}", np.zeros((20, 60, 3), np.float32)) for k in range(count)]
    given: list[Dentition | None] = [dentition(k, 11 if k in said else 0) for k in range(count)]
    first = Turned(views, given, fit(views, given))
    asked.clear()
    result = without_odd_ones(first, fit, kept)
    if not result.left_out:
        assert result is first
    else:
        assert [k for k, seen in enumerate(result.dentitions) if seen is None] == sorted(
            result.left_out
        )
        assert not result.fit.doubts and result.reasons == first.fit.doubts
    return result.left_out, asked


@pytest.mark.parametrize("odd", range(4))
def test_one_beside_three_that_agree_is_left_out(odd: int) -> None:
    assert left_out(4, lambda there: odd in there)[0] == (odd,)


def test_of_three_none_is_left_out_for_nobody_can_tell_which_is_right() -> None:
    out, asked = left_out(FEWEST, lambda there: 1 in there)
    assert (out, asked) == ((), [])


def test_where_the_rest_never_agrees_all_stay() -> None:
    assert left_out(5, lambda there: 1)[0] == ()


def test_the_surest_of_several_ways_is_taken() -> None:
    sure = {frozenset({0, 1, 3}): 0.9, frozenset({0, 1, 2}): 0.6}
    assert left_out(4, lambda there: {2, 3} <= there, sure=sure)[0] == (2,)


def test_two_go_one_after_the_other_that_with_most_doubts_first() -> None:
    out, asked = left_out(5, lambda there: 2 * (4 in there) + (1 in there))
    assert out == (4, 1)
    assert [len(there) for there in asked] == [4] * 5 + [3] * 4


def test_what_a_person_wants_or_has_numbered_stays() -> None:
    doubts = lambda there: 3 in there  # noqa: E731
    assert left_out(4, doubts, kept=(3,))[0] == ()
    assert left_out(4, doubts, said=(3,))[0] == ()


def test_of_many_none_is_left_out_for_it_would_take_too_long() -> None:
    assert left_out(MOST, lambda there: 0 in there)[0] == (0,)
    assert left_out(MOST + 1, lambda there: 0 in there) == ((), [])
