"""Which photographs are left out because the others agree without them: with a fit made up."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from pipeline.geometry.rigid import exponential
from stages.init.dental import reconstruct
from stages.init.dental.cameras.bundle import Adjusted
from stages.init.dental.cameras.unrolled import PairFigures
from stages.init.dental.mirror_images import Turned
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.confidence import unlike_neighbours
from stages.init.dental.odd_ones import MOST_TRIED, without_odd_ones
from stages.init.dental.solution import ArchFit, PlacedView

Doubts = Callable[[frozenset[int]], int]


#: Kinds of photographs where nothing else is said: all from the front, so that any three may
#: make a mouth.
FRONTS = "f" * 9
KINDS = {"f": "front", "r": "right", "l": "left"}


def dentition(number: int, tooth: int = 0, kind: str = "f") -> Dentition:
    corners = np.array([[5.0, 5], [11, 5], [11, 15], [5, 15]])
    crown = Crown(
        "upper", corners[0], corners[2], None, None, None, None, 6, 10, outline=corners,
        number=tooth, doubt=0.0 if tooth else 1.0,
    )  # fmt: skip
    return Dentition(f"{number:03d}", (60, 20), KINDS[kind], (crown,))


def left_out(
    count: int, doubts: Doubts, kept: tuple[int, ...] = (), said: tuple[int, ...] = (),
    sure: dict[frozenset[int], float] | None = None, kinds: str = FRONTS,
) -> tuple[tuple[int, ...], list[frozenset[int]]]:  # fmt: skip
    """Which of so many photographs are left out, and which sets were tried."""
    result, asked = outcome(count, doubts, kept, said, sure, kinds)
    assert not result.mouths
    return result.left_out, asked


def outcome(
    count: int, doubts: Doubts, kept: tuple[int, ...] = (), said: tuple[int, ...] = (),
    sure: dict[frozenset[int], float] | None = None, kinds: str = FRONTS,
) -> tuple[Turned, list[frozenset[int]]]:  # fmt: skip
    """What comes of so many photographs, and which sets were tried.

    Args:
        doubts: photographs that take part -> how many doubts there are about them.
        said: photographs of which a person has numbered a tooth.
        sure: photographs that take part -> confidence.
        kinds: from where each shows the teeth, by the first letter.
    """
    asked: list[frozenset[int]] = []

    def fit(views: list[View], dentitions: list[Dentition | None]) -> ArchFit:
        there = frozenset(k for k, seen in enumerate(dentitions) if seen is not None)
        asked.append(there)
        names = tuple(f"doubt {k}" for k in range(doubts(there)))
        confidence = (sure or {}).get(there, 0.3)
        return ArchFit((None,) * len(views), {}, {}, 0.0, names, confidence=confidence)

    views = [View(f"{k:03d}", np.zeros((20, 60, 3), np.float32)) for k in range(count)]
    given: list[Dentition | None] = [
        dentition(k, 11 if k in said else 0, kinds[k]) for k in range(count)
    ]
    first = Turned(views, given, fit(views, given))
    asked.clear()
    result = without_odd_ones(first, fit, kept)
    if not result.left_out:
        assert result.fit is first.fit and result.dentitions is first.dentitions
    else:
        assert [k for k, seen in enumerate(result.dentitions) if seen is None] == sorted(
            result.left_out
        )
        assert not result.fit.doubts and result.reasons == first.fit.doubts
    return result, asked


@pytest.mark.parametrize("odd", range(4))
def test_one_beside_three_that_agree_is_left_out(odd: int) -> None:
    assert left_out(4, lambda there: odd in there)[0] == (odd,)


def test_of_three_none_is_left_out_for_nobody_can_tell_which_is_right() -> None:
    out, asked = left_out(3, lambda there: 1 in there)
    assert (out, asked) == ((), [])


def test_where_the_rest_never_agrees_all_stay() -> None:
    assert left_out(5, lambda there: 1)[0] == ()


def test_the_surest_of_several_ways_is_taken() -> None:
    sure = {frozenset({0, 1, 3}): 0.9, frozenset({0, 1, 2}): 0.6}
    assert left_out(4, lambda there: {2, 3} <= there, sure=sure)[0] == (2,)


def test_two_of_another_mouth_go_whichever_of_the_others_fits_worst() -> None:
    """The greatest doubt is about one that belongs: with it there are most."""
    out, asked = left_out(
        5, lambda there: 2 * (0 in there and len(there) > 3) + bool({1, 4} & there)
    )
    assert out == (1, 4)
    assert {len(there) for there in asked} == {3, 4}


def test_of_two_sets_that_are_as_sure_nobody_can_tell_which_is_right() -> None:
    either = lambda there: {2, 3} <= there  # noqa: E731
    assert left_out(4, either, kinds="rfll")[0] == ()
    surer = {frozenset({0, 1, 2}): 0.36}
    assert left_out(4, either, sure=surer, kinds="rfll")[0] == (3,)
    # one that a person wants decides
    assert left_out(4, either, sure=surer, kinds="rfll", kept=(3,))[0] == (2,)


def test_half_of_them_are_no_reason_to_leave_out_the_others() -> None:
    doubts = lambda there: there != {0, 1, 2}  # noqa: E731
    assert outcome(6, doubts, kinds="rflrfl")[0].mouths == ((0, 1, 2),)
    assert left_out(5, doubts, kinds="rflfl")[0] == (3, 4)


def test_what_agrees_with_three_comes_to_them() -> None:
    out, asked = left_out(5, lambda there: 2 in there)
    assert out == (2,)
    assert max(map(len, asked)) == 4


def test_one_of_each_kind_makes_a_mouth() -> None:
    out, asked = left_out(4, lambda there: 3 in there, kinds="rflf")
    assert (out, asked) == ((3,), [frozenset({0, 1, 2}), frozenset({0, 2, 3})])


def test_two_mouths_are_told_and_neither_is_left_out() -> None:
    mouths = {frozenset({0, 1, 2}), frozenset({3, 4, 5})}
    doubts = lambda there: there not in mouths  # noqa: E731
    assert outcome(6, doubts, kinds="rflrfl")[0].mouths == ((0, 1, 2), (3, 4, 5))
    # where a mixture agrees as well, at most one is made out
    mouths.add(frozenset({0, 1, 5}))
    sure = {frozenset({0, 1, 2}): 0.9}
    assert outcome(6, doubts, sure=sure, kinds="rflrfl")[0].mouths == ((0, 1, 2),)


def test_what_is_seen_from_one_side_has_to_match() -> None:
    yaws = np.radians([-40.0, -33.0, 0.0, 4.0, 9.0, 40.0])
    turned = [exponential(np.array([0, 0, 0, 0, yaw, 0]))[0] for yaw in yaws]
    adjusted = cast(Adjusted, SimpleNamespace(rotations=np.array(turned)))

    def doubts(*shares: float) -> list[str]:
        pairs = {(k, k + 1): PairFigures(9, share, 0.01) for k, share in enumerate(shares)}
        return unlike_neighbours([f"{k}.jpg" for k in range(6)], adjusted, pairs, ArchOptions())

    # what is seen from far apart never matches as much, and one neighbour that matches is enough
    assert doubts(0.2, 0.01, 0.2, 0.2, 0.01) == []
    (told,) = doubts(0.03, 0.01, 0.2, 0.2, 0.01)
    assert told.startswith("0.jpg and 1.jpg show the teeth from nearly the same side")
    assert "(3 %)" in told
    (told,) = doubts(0.2, 0.01, 0.2, 0.04, 0.01)
    assert told.startswith("3.jpg and 4.jpg")


@pytest.mark.parametrize(
    ("mouths", "told"),
    [
        (
            {frozenset({0, 2, 4})},
            "half fit each other, 0.jpg, 2.jpg, 4.jpg, and none of the others fits them",
        ),
        (
            {frozenset({0, 2, 4}), frozenset({1, 3, 5})},
            "of two patients, or of two visits: 0.jpg, 2.jpg, 4.jpg fit each other, and so do "
            "1.jpg, 3.jpg, 5.jpg,",
        ),
    ],
)
def test_a_folder_of_two_patients_is_refused_by_their_photographs_names(
    monkeypatch: pytest.MonkeyPatch, mouths: set[frozenset[int]], told: str
) -> None:

    def fit(dentitions: list[Dentition | None], *_: object) -> ArchFit:
        there = frozenset(k for k, seen in enumerate(dentitions) if seen)
        placed = PlacedView(np.eye(4), 90.0, "frontal", (11,), (), 1.0, (0.0,))
        doubts = () if there in mouths else ("one may show another patient",)
        return ArchFit(tuple(d and placed for d in dentitions), {}, {}, 50.0, doubts)

    monkeypatch.setattr(reconstruct, "fit_arch", fit)
    views = [View(f"{k:03d}", np.zeros((20, 60, 3), np.float32)) for k in range(6)]
    with pytest.raises(ReconstructionError) as refused:
        reconstruct.place_teeth(
            views, [f"{k}.jpg" for k in range(6)],
            [dentition(k, kind=kind) for k, kind in enumerate("rrffll")],
            [None] * 6, ArchOptions(), accept_doubtful=False, threads=1,
            progress=lambda *_: None,
        )  # fmt: skip
    assert told in str(refused.value)
    assert "teeth" in refused.value.pictures and "teeth" in refused.value.artifacts


def test_what_a_person_wants_or_has_numbered_stays() -> None:
    doubts = lambda there: 3 in there  # noqa: E731
    assert left_out(4, doubts, kept=(3,))[0] == ()
    assert left_out(4, doubts, said=(3,))[0] == ()
    either = lambda there: {2, 3} <= there  # noqa: E731
    surer = {frozenset({0, 1, 2}): 0.9}
    assert left_out(4, either, sure=surer)[0] == (3,)
    assert left_out(4, either, sure=surer, kept=(3,))[0] == (2,)


def test_of_many_none_is_left_out_for_it_would_take_too_long() -> None:
    assert len(left_out(7, lambda there: 0 in there, kinds="rrfffll")[1]) >= MOST_TRIED
    assert left_out(8, lambda there: 0 in there, kinds="rrffflll") == ((), [])
