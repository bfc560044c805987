"""Which primary teeth a patient still has.

Teeth change in an order, more or less: in each jaw the incisors first, then canine and molars one
way or another (about six to twelve years of age). Every pair of upper and lower sets of teeth that
comes of it is weighed: by the looks of the crowns in all photographs, and by how well the arch of
such a child explains where the crowns lie. Then single teeth may be out of order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import JAWS, is_primary, permanent_of, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.tooth_rows import NO_TOOTH, believed, number_is_said
from stages.init.dental.numbering.hypotheses import SEARCH_STEPS, Labelling, Scored, Scorer
from stages.init.dental.template import tooth_at

Array = npt.NDArray[np.float64]

#: Places from the midline at which a jaw's primary teeth are left, as they go: incisors first; then
#: the canine mostly first in the lower jaw and last in the upper one.
LEFT = ((1, 2, 3, 4, 5), (2, 3, 4, 5), (3, 4, 5), (4, 5), (3, 5), (5,), (3,), ())
#: The permanent numbers in whose place a primary tooth can stand.
ALL_PRIMARY = frozenset(tooth for jaw in JAWS for tooth in teeth_of(jaw) if tooth % 10 <= 5)
#: Jaws change together: cost of each place more that one of them has lost.
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
#: Less probable than this is as good as not at all.
LEAST_PROBABILITY = 1e-4
#: But within one mouth the looks of primary and permanent teeth differ by this much (log odds, 7 to
#: 12 in the 14 labelled photographs that show both), with this deviation; one tooth speaks against
#: a set by no more than so many deviations. Beside generated children changing their teeth (273
#: teeth of 12) from 2.5 to 3 and 7 to 10 leave 7 to 12 teeth wrong by looks alone.
CONTRAST, DEVIATION, MOST_DEVIATIONS = 8.0, 3.0, 3.0
#: Cost of each tooth that went before or after its turn, or that of the other side (3 to 6 are as
#: good; no tooth of twelve patients nor of 27 generated ones with one set is called so).
OUT_OF_ORDER_COST = 4.0
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
    looks = {tooth: value for tooth, value in looks.items() if tooth % 10 <= 5}
    places = [_back_place(label) for rows in best.labelling.labels for row in rows for label in row]
    first_molars, second_molars = places.count(6), places.count(7)
    said = said_numbers(dentitions)
    start = (best.adjusted.unknowns, best.adjusted.offsets)

    @cache
    def cost_of(teeth: frozenset[int]) -> float:
        solved = scorer.solve(replace(best.labelling, primary=teeth), start, SEARCH_STEPS)
        cost = ARCH_SHARE * solved.score + looks_cost(looks, teeth)
        if teeth:
            cost += LATE_MOLAR_COST * second_molars
        if any(tooth % 10 == 1 for tooth in teeth):
            cost += EARLY_MOLAR_COST * first_molars
        return cost

    found: list[tuple[float, frozenset[int]]] = []
    for upper, lower in product(LEFT, LEFT):
        left = {"upper": upper, "lower": lower}
        teeth = {t for jaw in JAWS for t in teeth_of(jaw) if t % 10 in left[jaw]}
        chosen = frozenset(t for t in teeth if said.get(t, True)) | {t for t in said if said[t]}
        order = APART_COST * abs(len(upper) - len(lower))
        order += CHANGING_COST * sum(0 < len(jaw) < len(LEFT[0]) for jaw in (upper, lower))
        found.append((cost_of(chosen) + order, chosen))
    cost, primary = min(found, key=_cheapest)
    while True:
        turns = [primary ^ {tooth} for tooth in looks if tooth not in said]
        gain = looks_cost(looks, primary) - OUT_OF_ORDER_COST
        turns = [teeth for teeth in turns if looks_cost(looks, teeth) < gain]
        cheaper = cost - cost_of(primary) + OUT_OF_ORDER_COST
        nearest = min(((cheaper + cost_of(t), t) for t in turns), key=_cheapest, default=None)
        if nearest is None or nearest[0] >= cost:
            return cost, primary
        cost, primary = nearest


def _cheapest(found: tuple[float, frozenset[int]]) -> tuple[float, list[int]]:
    """Sort key that never ties by chance."""
    return found[0], sorted(found[1])


def looks_cost(looks: Mapping[int, float], primary: frozenset[int]) -> float:
    """What looks speak against a set of primary teeth (evidence).

    Args:
        looks: permanent number of each tooth seen -> log odds that a primary one stands there.
        primary: in whose places primary ones are said to stand.
    """
    if not looks:
        return 0.0
    odds = np.array(list(looks.values()))
    milk = np.array([tooth in primary for tooth in looks])
    even = EVEN_ODDS
    if milk.any() and not milk.all():
        even = max(even, float(odds[milk].mean()) - CONTRAST / 2)
    clear = np.clip(odds - even, -MOST_ODDS, MOST_ODDS)
    alike = np.where(milk, odds, odds + CONTRAST)
    off = np.abs(alike - alike.mean()) / DEVIATION
    return float(
        -CROWNS_COUNTED * np.where(milk, clear, -clear).mean()
        + (np.minimum(off, MOST_DEVIATIONS) ** 2).sum()
    )


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
    return float(np.log(max(milk, LEAST_PROBABILITY) / max(rest, LEAST_PROBABILITY)))


def said_numbers(dentitions: list[Dentition]) -> dict[int, bool]:
    """Permanent number -> whether a person has said that a primary tooth stands there."""
    return {
        permanent_of(crown.number): is_primary(crown.number)
        for dentition in dentitions
        for crown in dentition.all_crowns
        if number_is_said(crown) and crown.number % 10 <= 5
    }
