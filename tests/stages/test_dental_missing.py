"""Teeth missing in the patient: what they cost, and the labellings that are tried for them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from pipeline.artifacts.dental.fdi import is_upper
from stages.init.dental.cameras.bundle import ARCH_CENTRE, nominal_rotation
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.labellings.edits import missing_tooth_edits, with_row
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
)
from stages.init.dental.template import position_of

OPTIONS = ArchOptions()


def cost(*teeth: int) -> float:
    return OPTIONS.cost_of_missing(frozenset(teeth))


def labelling(*views: tuple[int, ...]) -> Labelling:
    """Photographs whose crowns have these FDI numbers, upper and lower, left to right."""
    rows = []
    for teeth in views:
        upper = tuple(position_of(t) for t in teeth if is_upper(t))
        rows.append((upper, tuple(position_of(t) for t in teeth if not is_upper(t))))
    roles = ("right", "frontal", "left")[: len(views)]
    return Labelling(tuple(range(len(views))), roles, tuple(rows))


def seen_from(*yaws: float) -> Any:
    """What edits read of a solution: cameras at these yaws, 120 mm from the arch."""
    turns = np.array([nominal_rotation(yaw, 0.0) for yaw in yaws])
    away = np.array([0.0, 0.0, 120.0])
    return SimpleNamespace(
        rotations=turns, translations=np.array([away - turn @ ARCH_CENTRE for turn in turns])
    )


def test_premolars_are_missing_more_often_and_in_pairs() -> None:
    assert cost() == 0
    assert 0 < cost(15) < cost(14) < cost(16) == cost(12)
    assert cost(15) < cost(15, 25) < 1.5 * cost(15), "the other side's comes along"
    assert cost(15, 35) == 2 * cost(15), "another jaw's does not"
    assert cost(16, 26) == 2 * cost(16), "nor do molars"
    child = OPTIONS.of_a_child()
    for teeth in ({15}, {14, 24}, {12, 15, 25}):
        assert child.cost_of_missing(frozenset(teeth)) == len(teeth) * cost(16), (
            "primary molars stay"
        )


def test_a_missing_tooth_takes_up_the_gap_behind_it() -> None:
    """24, 25, 27 may be 24, 26, 27: what stood there as hidden is what was taken for 25."""
    now = labelling((21, 22, 23, 24, 25, 27), (21, 22, 23, 24, 25))
    edits = [e for e in missing_tooth_edits(now, seen_from(0.0, 45.0)) if e.absent == {25}]
    wanted = labelling((21, 22, 23, 24, 26, 27), (21, 22, 23, 24, 26)).labels
    assert {e.closed for e in edits if e.labels == wanted} == {frozenset(), frozenset({25})}
    all_moved = [e.labels[0][0] for e in edits if e.labels[0][0][-1] < 0]
    assert all_moved, "or the last one is no tooth any more"


def test_a_photograph_that_already_leaves_the_place_empty_stays() -> None:
    now = labelling((21, 22, 23, 24, 26), (21, 22, 23, 24, 25))
    edits = missing_tooth_edits(now, seen_from(0.0, 45.0))
    wanted = labelling((21, 22, 23, 24, 26), (21, 22, 23, 24, 26)).labels
    assert any(e.labels == wanted and e.absent == {25} for e in edits)


def test_what_a_photograph_shows_is_not_missing() -> None:
    now = replace(
        labelling((22, 23, 25), (22, 23, 25)), absent=frozenset({24}), closed=frozenset({24})
    )
    row = labelling((22, 23, 24)).labels[0][0]
    changed = with_row(now, 1, 0, row)
    assert changed.labels[1][0] == row
    assert not changed.absent and not changed.closed
    lower = with_row(now, 1, 1, labelling((34,)).labels[0][1])
    assert lower.absent == {24}, "the other jaw's"
