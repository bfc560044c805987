"""The last crowns of the rows: which tooth what is seen of them can be."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS
from stages.dentition.tooth_rows import NO_TOOTH, POSITIONS
from stages.init.dental.numbering.labellings.ends import (
    MOST_COST,
    end_labels,
    ends_cost,
    hidden_at_ends,
)
from stages.init.dental.numbering.labellings.scorer import (
    row_defects,
)
from stages.init.dental.numbering.labellings.search import (
    row_pairs,
)
from stages.init.dental.numbering.sightings import SeenRow
from stages.init.dental.template import LANDMARKS_A_JAW, PAPILLA, ZENITH

#: Teeth are as wide as their position says, pixels: each a little wider than the one before.
EDGES = np.cumsum([0, *range(10, 10 + POSITIONS)])
BAND = 40.0


def solution() -> Any:
    """Landmarks in a line, seen straight on, pixels for millimetres."""
    points = np.zeros((2 * LANDMARKS_A_JAW, 3))
    for start in (0, LANDMARKS_A_JAW):
        points[start + ZENITH : start + ZENITH + POSITIONS, 0] = (EDGES[:-1] + EDGES[1:]) / 2
        points[start + PAPILLA : start + PAPILLA + POSITIONS - 1, 0] = EDGES[1:-1]
    return SimpleNamespace(points=points, project=lambda view, points: points[:, :2])


def row_of(positions: list[int]) -> SeenRow:
    """Crowns that fill the places of these positions."""
    count = len(positions)
    nothing = np.full((count, 2), np.nan)
    places = np.array(positions, np.int64)
    lefts, rights = EDGES[places].astype(float), EDGES[places + 1].astype(float)
    return SeenRow(
        jaw="upper", middles=nothing, widths=rights - lefts, lefts=lefts, rights=rights, band=BAND,
        zeniths=nothing, tips=nothing, papillae_left=nothing, papillae_right=nothing,
        embrasures_left=nothing, embrasures_right=nothing, doubtful=np.zeros(count, bool),
        looks=np.zeros((count, POSITIONS)), scores=np.ones(count),
    )  # fmt: skip


def cost(row: SeenRow, labels: tuple[int, ...]) -> float:
    empty = row_of([])
    return ends_cost([(row, empty)], (0,), ((labels, ()),), solution())


def test_crowns_in_their_places_cost_nothing() -> None:
    assert cost(row_of([0, 1, 2, 3, 4]), (0, 1, 2, 3, 4)) == 0
    assert cost(row_of([9, 10, 11, 12, 13]), (9, 10, 11, 12, 13)) == 0


def test_a_crown_wider_than_its_tooth_costs() -> None:
    row = row_of([3, 4, 5, 6, 7])
    wide = replace(row, rights=row.rights + np.array([0, 0, 0, 0, 8.0]))
    labels = (3, 4, 5, 6, 7)
    assert cost(wide, labels) > 1
    # Less of it seen than there is costs nothing: it may be hidden.
    assert cost(replace(row, rights=row.rights - np.array([0, 0, 0, 0, 8.0])), labels) == 0


def test_a_crown_that_begins_before_its_tooth_costs() -> None:
    row = row_of([3, 4, 5, 6, 7])
    assert cost(row, (3, 4, 5, 6, 8)) == pytest.approx(MOST_COST)
    assert 8 < cost(row, (2, 4, 5, 6, 7)) < MOST_COST
    assert cost(row, (NO_TOOTH, 4, 5, 6, 7)) == 0


def test_hidden_teeth_before_the_ends_are_no_defects() -> None:
    nothing: frozenset[int] = frozenset()
    assert hidden_at_ends((2, 4, 5, 6, 9), nothing) == 1 + 2
    assert hidden_at_ends((2, 4, 5, 6, 9), frozenset({3, 7})) == 1
    assert hidden_at_ends((NO_TOOTH, 4, 5, 7, 8), nothing) == 0
    assert row_defects((2, 4, 5, 6, 9), nothing) == 0
    assert row_defects((2, 3, 5, 6, 7), nothing) == 1


def test_other_labels_of_the_ends() -> None:
    assert set(end_labels((4, 5, 6, 7), 2)) == {
        (3, 5, 6, 7), (2, 5, 6, 7), (4, 5, 6, 8), (4, 5, 6, 9),
    }  # fmt: skip
    assert set(end_labels((0, 1, 2, 5), 1)) == {(0, 1, 2, 3), (0, 1, 2, 4)}
    assert end_labels((3, NO_TOOTH, NO_TOOTH, 6), 2) == []
    assert end_labels((3, 4), 2) == []


def test_jaws_whose_looks_contradict_each_other_are_not_left_without_a_name() -> None:
    """Anatomy would allow neither row beside the other."""
    rows = []
    for jaw, first in zip(JAWS, (0, 7), strict=True):
        row = row_of([0, 1, 2, 3, 4, 5])
        looks = np.full((6, POSITIONS), -30.0)
        looks[np.arange(6), first + np.arange(6)] = 0.0
        middles = np.stack([row.lefts + row.rights, np.zeros(6)], 1) / 2
        rows.append(replace(row, jaw=jaw, looks=looks, middles=middles))
    upper, lower = rows
    assert row_pairs((upper, lower), 16)
    assert row_pairs((upper, upper), 16)[0] == ((0, 1, 2, 3, 4, 5),) * 2
