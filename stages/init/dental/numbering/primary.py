"""Which primary teeth a patient still has.

Teeth change in an order: in each jaw the central incisors first, the second primary molars last
(about six to twelve years of age), so that the primary ones left are those behind some place. Every
such pair of places, upper and lower, is weighed: by the looks of the crowns in all photographs, and
by how well the arch of such a child explains where the crowns lie.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, is_primary, permanent_of, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.tooth_rows import NO_TOOTH, believed, number_is_said
from stages.init.dental.numbering.hypotheses import SEARCH_STEPS, Labelling, Scored, Scorer
from stages.init.dental.template import tooth_at

Array = npt.NDArray[np.float64]

#: Places from the midline at which the primary teeth begin: all, none of the incisors, ..., none.
BEGINNINGS = (1, 2, 3, 4, 5, 6)
#: The permanent numbers in whose place a primary tooth can stand.
ALL_PRIMARY = frozenset(tooth for jaw in JAWS for tooth in teeth_of(jaw) if tooth % 10 <= 5)
#: Jaws change together: cost of each place between the upper and the lower beginning.
APART_COST = 4.0
#: Cost of a jaw amid the change: it lasts some years of a patient's, and looks like errors of both.
CHANGING_COST = 5.0
#: Cost of each second molar seen beside primary teeth (they come when the last of those go), and of
#: each first molar beside primary central incisors (the one comes when the other goes).
LATE_MOLAR_COST, EARLY_MOLAR_COST = 8.0, 3.0
#: Log odds by the looks of a crown at which primary and permanent are as likely: the reader has
#: seen far fewer primary teeth than there are among children. Means over the crowns of a patient
#: are -4.3 to -1.4 in four children, -11.1 to -8.6 in eight adults.
EVEN_ODDS = -7.0
#: Less probable than this is as good as not at all: it already counts `MOST_ODDS` by even odds.
LEAST_PROBABILITY = 1e-4
#: Odds of one crown count no more than this.
MOST_ODDS = 2.0
#: Mean log odds this much below even still ask for a look at a child's arch.
CHILD_WINDOW = 0.7
#: Crowns with less probability than this of standing before the molars say nothing.
LEAST_SHARE = 0.05
#: The looks of the crowns of a patient err together: their mean counts as so many.
CROWNS_COUNTED = 12.0
#: The arch's evidence is taken at this share: spaces between teeth are not in the textbook.
ARCH_SHARE = 0.5


def perhaps_primary(dentitions: list[Dentition]) -> bool:
    """Do the crowns look so that this may be a child's mouth?"""
    odds = [_odds(crown) for dentition in dentitions for crown in dentition.all_crowns]
    known = [value for value in odds if value is not None]
    return bool(known) and float(np.mean(known)) > -CHILD_WINDOW


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
    odds = place_odds(best.labelling, dentitions)
    places = [_back_place(label) for rows in best.labelling.labels for row in rows for label in row]
    first_molars, second_molars = places.count(6), places.count(7)
    said = said_numbers(dentitions)
    start = (best.adjusted.unknowns, best.adjusted.offsets)
    found: list[tuple[float, frozenset[int]]] = []
    for upper, lower in product(BEGINNINGS, BEGINNINGS):
        teeth = frozenset(
            tooth
            for jaw, beginning in zip(JAWS, (upper, lower), strict=True)
            for tooth in teeth_of(jaw)
            if beginning <= tooth % 10 <= 5
        )
        teeth = frozenset(t for t in teeth if said.get(t, True)) | {t for t in said if said[t]}
        solved = scorer.solve(replace(best.labelling, primary=teeth), start, SEARCH_STEPS)
        cost = ARCH_SHARE * solved.score + APART_COST * abs(upper - lower)
        cost += CHANGING_COST * sum(1 < beginning < 6 for beginning in (upper, lower))
        if teeth:
            cost += LATE_MOLAR_COST * second_molars
        if min(upper, lower) == 1:
            cost += EARLY_MOLAR_COST * first_molars
        seen = {tooth: value for tooth, value in odds.items() if tooth % 10 <= 5}
        if seen:
            mean = sum(v if t in teeth else -v for t, v in seen.items()) / len(seen)
            cost -= CROWNS_COUNTED * mean
        found.append((cost, teeth))
    return min(found, key=lambda item: (item[0], sorted(item[1])))


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
                odds = _odds(crown)
                if odds is not None:
                    values.setdefault(tooth_at(jaw, label), []).append(odds)
    return {tooth: float(np.mean(odds)) for tooth, odds in values.items()}


def _odds(crown: Crown) -> float | None:
    """Log odds by its looks that a crown is primary; None where nothing is known of them."""
    numbers = believed(crown)
    milk = sum(p for number, p in numbers.items() if is_primary(number))
    rest = sum(p for number, p in numbers.items() if not is_primary(number) and number % 10 <= 5)
    if milk + rest < LEAST_SHARE:
        return None
    return float(
        np.clip(
            np.log(max(milk, LEAST_PROBABILITY) / max(rest, LEAST_PROBABILITY)) - EVEN_ODDS,
            -MOST_ODDS, MOST_ODDS,
        )
    )  # fmt: skip


def said_numbers(dentitions: list[Dentition]) -> dict[int, bool]:
    """Permanent number -> whether a person has said that a primary tooth stands there."""
    return {
        permanent_of(crown.number): is_primary(crown.number)
        for dentition in dentitions
        for crown in dentition.all_crowns
        if number_is_said(crown) and crown.number % 10 <= 5
    }
