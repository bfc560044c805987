"""Which primary teeth a patient still has.

Every set that the order of change allows (`changing_teeth`) is weighed: by the looks of the crowns
in all photographs, and by how well the arch of such a child explains where the crowns lie.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from pipeline.artifacts.dental.fdi import JAWS, PRIMARY_PLACES, teeth_of
from pipeline.artifacts.teeth import Dentition
from stages.dentition.changing_teeth import (
    EVEN_ODDS,
    MOST_ODDS,
    cheapest_left,
    looks_cost,
    molars_cost,
    primary_odds,
    said_numbers,
)
from stages.dentition.tooth_rows import NO_TOOTH
from stages.init.dental.numbering.labellings.scorer import (
    SEARCH_STEPS,
    Labelling,
    Scored,
    Scorer,
)
from stages.init.dental.template import tooth_at

#: The permanent numbers in whose place a primary tooth can stand.
ALL_PRIMARY = frozenset(
    tooth for jaw in JAWS for tooth in teeth_of(jaw) if tooth % 10 <= PRIMARY_PLACES
)
#: Mean log odds this much below even still ask for a look at a child's arch.
CHILD_WINDOW = 0.7
#: The arch's evidence is taken at this share: spaces between teeth are not in the textbook.
ARCH_SHARE = 0.5


def perhaps_primary(dentitions: list[Dentition]) -> bool:
    """Do the crowns look so that this may be a child's mouth?"""
    odds = [primary_odds(crown) for dentition in dentitions for crown in dentition.all_crowns]
    known = np.array([value for value in odds if value is not None])
    clear = np.clip(known - EVEN_ODDS, -MOST_ODDS, MOST_ODDS)
    return bool(len(known)) and float(clear.mean()) > -CHILD_WINDOW


def primary_teeth(
    scorer: Scorer, best: Scored, dentitions: list[Dentition]
) -> tuple[float, frozenset[int]]:
    """Permanent numbers (11-45) in whose place primary teeth stand, and what that costs.

    Args:
        scorer, best: a labelling.
        dentitions: the crowns of its photographs with their probabilities.

    Returns:
        The cost (evidence, to compare labellings with) and the teeth.
    """
    looks = place_odds(best.labelling, dentitions)
    looks = {tooth: value for tooth, value in looks.items() if tooth % 10 <= PRIMARY_PLACES}
    places = [_back_place(label) for rows in best.labelling.labels for row in rows for label in row]
    first_molars, second_molars = places.count(6), places.count(7)
    said = said_numbers(dentitions)
    start = (best.adjusted.unknowns, best.adjusted.offsets)

    @cache
    def cost_of(teeth: frozenset[int]) -> float:
        solved = scorer.solve(replace(best.labelling, primary=teeth), start, SEARCH_STEPS)
        molars = molars_cost(teeth, first_molars, second_molars)
        return ARCH_SHARE * solved.score + looks_cost(looks, teeth) + molars

    return cheapest_left(looks, said, cost_of)


def _back_place(label: int) -> int:
    """Place from the midline of a position along the row, 0 for `NO_TOOTH`."""
    return 0 if label == NO_TOOTH else tooth_at("upper", label) % 10


def place_odds(labelling: Labelling, dentitions: list[Dentition]) -> dict[int, float]:
    """Permanent number -> mean log odds, by looks, that a primary tooth stands there."""
    values: dict[int, list[float]] = {}
    for dentition, rows in zip(dentitions, labelling.labels, strict=True):
        for jaw, labels in zip(JAWS, rows, strict=True):
            for crown, label in zip(dentition.crowns(jaw), labels, strict=True):
                if label == NO_TOOTH:
                    continue
                odds = primary_odds(crown)
                if odds is not None:
                    values.setdefault(tooth_at(jaw, label), []).append(odds)
    return {tooth: float(np.mean(odds)) for tooth, odds in values.items()}
