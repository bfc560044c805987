"""Which primary teeth a patient still has, by the looks of the crowns in all photographs."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.fdi import JAWS, is_primary, teeth_of
from pipeline.artifacts.teeth import Dentition
from stages.geometry.tooth_rows import POSITIONS, row_probabilities
from stages.init.dental.numbering.sightings import LOOKS, SeenRow, believed

#: Looks of one crown never count for more than this (log odds): photographs err together.
MOST_ODDS = 3.0
#: Neighbours change their teeth at about the same age: their odds count by this much.
NEIGHBOURS = 0.25


def primary_teeth(
    dentitions: list[Dentition], rows: list[tuple[SeenRow, SeenRow]]
) -> frozenset[int]:
    """Permanent numbers (11-45) in whose place primary teeth stand.

    Args:
        dentitions: the crowns of each photograph with their probabilities.
        rows: the same crowns as `sightings.seen_rows` has them.
    """
    found: set[int] = set()
    odds = {jaw: np.zeros(POSITIONS) for jaw in JAWS}
    for dentition, pair in zip(dentitions, rows, strict=True):
        for jaw, row in zip(JAWS, pair, strict=True):
            shares, _ = row_probabilities(row.looks, LOOKS)
            for crown, share in zip(dentition.crowns(jaw), shares, strict=True):
                numbers = believed(crown)
                milk = sum(p for tooth, p in numbers.items() if is_primary(tooth))
                rest = sum(p for tooth, p in numbers.items() if not is_primary(tooth))
                sure = np.log(max(milk, 0.02) / max(rest, 0.02))
                odds[jaw] += np.clip(sure, -MOST_ODDS, MOST_ODDS) * share[:POSITIONS]
    for jaw in JAWS:
        own = odds[jaw]
        beside = np.concatenate([[0], own[:-1]]) + np.concatenate([own[1:], [0]])
        for tooth, sum_of_odds in zip(teeth_of(jaw), own + NEIGHBOURS * beside, strict=True):
            if tooth % 10 <= 5 and sum_of_odds > 0:
                found.add(tooth)
    return frozenset(found)
