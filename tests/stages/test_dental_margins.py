"""Rivals of a labelling: those that turn cameras, those that rename what one photograph shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import pytest

from stages.dentition.overlay import DOUBT_SHOWN
from stages.init.dental.numbering.labellings.edits import shifted_labellings
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
    Scored,
)
from stages.init.dental.numbering.rivals import (
    LEAST_DOUBT,
    NEAR_DOUBT,
    PICTURED_WINDOW,
    Margins,
    differences,
    judged_by_pictures,
    label_doubts,
    margins,
)
from stages.init.dental.place import numbered_otherwise

#: Upper and lower rows of a photograph from the right, from the front and from the left.
RIGHT = ((0, 1, 2, 3, 4, 5, 6, 7), (0, 1, 2, 3, 4, 5, 6, 7))
FRONT = ((3, 4, 5, 6, 7, 8, 9, 10), (3, 4, 5, 6, 7, 8, 9, 10))
LEFT = ((6, 7, 8, 9, 10, 11, 12, 13), (6, 7, 8, 9, 10, 11, 12, 13))
#: The first premolar (position 3) missing: what lies behind it, on the right alone, is renamed.
GAP = ((-1, 0, 1, 2, 4, 5, 6, 7), RIGHT[1])
#: The photograph from the left a tooth further back.
MOVED = ((7, 8, 9, 10, 11, 12, 13, -1), LEFT[1])


@dataclass(frozen=True)
class Unsolved:
    """A labelling with a score and no cameras."""

    labelling: Labelling
    score: float


def scored(score: float, *labels: Any) -> Scored:
    labelling = Labelling(views=(0, 1, 2), roles=("right", "frontal", "left"), labels=labels)
    return cast(Scored, Unsolved(labelling, score))


def test_what_one_photograph_alone_shows_ties_nothing() -> None:
    best, gap, moved = (
        scored(0, *labels).labelling
        for labels in ((RIGHT, FRONT, LEFT), (GAP, FRONT, LEFT), (RIGHT, FRONT, MOVED))
    )
    assert differences(best, best) == (0, 0)
    # Of positions 0 to 3, the first is an end of the row; the last is seen from the front, too.
    assert differences(best, gap) == differences(gap, best) == (3, 1)
    # From the left all six inner crowns; four of them are seen from the front by one or the other.
    assert differences(best, moved) == (6, 4)


def test_a_shift_of_all_photographs_ties_them_otherwise() -> None:
    everything = [tuple(tuple(k + 1 for k in row) for row in view) for view in (RIGHT, FRONT)]
    best, shifted = scored(0, RIGHT, FRONT, LEFT), scored(3, *everything, MOVED)
    assert margins(best, [shifted]).cameras == 3


def test_both_sides_are_shifted_at_once() -> None:
    """A lower jaw that both sides show a tooth too far back: half way back is worse than none."""
    right, left = ((*RIGHT[0],), (*RIGHT[1],)), ((*LEFT[0],), (*LEFT[1],))
    off = (right[0], (-1, *right[1][:-1])), (left[0], (*left[1][1:], -1))
    best = scored(0, off[0], FRONT, off[1]).labelling
    tried = shifted_labellings(best)
    assert len(tried) == len(set(tried))
    back = (right[0], (-1, *right[1][1:])), (left[0], (*left[1][:-1], -1))
    assert any(labelling.labels == (back[0], FRONT, back[1]) for labelling in tried)
    many = Labelling(tuple(range(5)), ("frontal",) * 5, (FRONT,) * 5)
    assert len(shifted_labellings(many)) == 3 * 2 * (5 + 1)  # of more, only one or all


def test_margins_are_told_apart() -> None:
    best = scored(10, RIGHT, FRONT, LEFT)
    one = ((0, 1, 2, 3, 4, 5, 7, 8), RIGHT[1])
    others = [
        scored(12, one, FRONT, LEFT), scored(15, GAP, FRONT, LEFT), scored(30, RIGHT, FRONT, MOVED),
        scored(17, GAP, FRONT, LEFT),
    ]  # fmt: skip
    assert margins(best, others) == Margins(cameras=20, numbers=5, local=2)
    assert margins(best, [best]) == Margins(math.inf, math.inf, math.inf)


#: Shares of the pairs that match where crowns are laid over themselves, and where one photograph is
#: a tooth off.
IN_PLACE, OFF = {(0, 1): 0.02, (1, 2): 0.04}, {(0, 1): 0.02, (1, 2): 0.005}


def test_pictures_of_other_teeth_speak_against_a_shifted_row() -> None:
    best, moved = scored(0, RIGHT, FRONT, LEFT), scored(5, RIGHT, FRONT, (MOVED[0], MOVED[0]))
    # a rival like it but for an end of the row has its pictures; one that is far off is not asked
    like = scored(7, RIGHT, FRONT, (MOVED[0], (*MOVED[0][:-2], -1, -1)))
    far = scored(PICTURED_WINDOW + 1, RIGHT, FRONT, MOVED)
    asked = []

    def shares(labelling: Scored) -> dict[tuple[int, int], float]:
        asked.append(labelling)
        return IN_PLACE if labelling is best else OFF

    end = scored(-0.5, (RIGHT[0], (-1, *RIGHT[1][1:])), FRONT, LEFT)  # a trace better: left, before
    winner, (*_, first, second, third) = judged_by_pictures(best, [end, moved, like, far], shares)
    assert winner is best
    assert asked == [best, moved]
    assert first.score == pytest.approx(5 + 4.7 * math.log(0.042 / 0.007))
    assert second.score - like.score == first.score - moved.score
    assert third == far


def test_pictures_choose_between_near_labellings() -> None:
    best, moved = scored(0, RIGHT, FRONT, (MOVED[0], MOVED[0])), scored(5, RIGHT, FRONT, LEFT)
    winner, others = judged_by_pictures(best, [moved], lambda s: OFF if s is best else IN_PLACE)
    assert winner.labelling == moved.labelling
    assert winner.score < 0
    assert others == [best]


def test_pictures_say_nothing_where_all_photographs_are_renamed_alike() -> None:
    """The same crowns lie over each other, whatever they are called."""
    best = scored(0, RIGHT, FRONT, LEFT)
    back = [tuple(tuple(k - 1 for k in row) for row in view) for view in (FRONT, LEFT)]
    renamed = scored(3, RIGHT, *back)
    winner, (other,) = judged_by_pictures(
        best, [renamed], lambda s: {(0, 1): 0.02, (1, 2): 0.04 if s is best else 0.001}
    )
    assert (winner, other) == (best, renamed)


def test_nobody_is_asked_where_no_rival_is_near() -> None:
    best, gap = scored(0, RIGHT, FRONT, LEFT), scored(3, GAP, FRONT, LEFT)
    assert judged_by_pictures(best, [gap], lambda s: pytest.fail("asked")) == (best, [gap])


def test_numbers_that_a_near_rival_has_otherwise_are_marked() -> None:
    best, rival = scored(0, RIGHT, FRONT, LEFT), scored(5.5, GAP, FRONT, LEFT)
    (upper, lower), front, left = label_doubts(best, [rival], least_margin=6.0)
    assert upper[:4] == (NEAR_DOUBT,) * 4
    assert NEAR_DOUBT > DOUBT_SHOWN
    assert {*upper[4:], *lower, *front[0], *left[0]} == {LEAST_DOUBT}
    far = label_doubts(best, [rival], least_margin=5.0)
    assert LEAST_DOUBT < far[0][0][0] < 0.1


def test_it_is_said() -> None:
    def said(figures: dict[str, float]) -> list[str]:
        return numbered_otherwise(cast(Any, SimpleNamespace(fit=SimpleNamespace(figures=figures))))

    (sentence,) = said({"numbers_margin": 5.2})
    assert "margin 5, wanted 6" in sentence
    assert said({"numbers_margin": 6.2}) == said({}) == []
