"""Which primary teeth are left in a mouth, by the looks of its crowns and the order of change.

Teeth change in an order, more or less: in each jaw the incisors first, then canine and molars one
way or another (about six to twelve years of age). Every pair of upper and lower sets of teeth that
comes of it is weighed; then single teeth may be out of order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import product

import numpy as np

from pipeline.artifacts.dental.fdi import JAWS, PRIMARY_PLACES, is_primary, permanent_of, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.errors import RequestError
from stages.dentition.tooth_rows import believed, number_is_said

#: Places from the midline at which a jaw's primary teeth are left, as they go: incisors first; then
#: the canine mostly first in the lower jaw and last in the upper one.
LEFT = ((1, 2, 3, 4, 5), (2, 3, 4, 5), (3, 4, 5), (4, 5), (3, 5), (5,), (3,), ())
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
#: Crowns with less probability than this of standing before the molars say nothing.
LEAST_SHARE = 0.05
#: The looks of the crowns of a patient err together: their mean counts as so many.
CROWNS_COUNTED = 12.0


def primary_odds(crown: Crown) -> float | None:
    """Log odds by its looks that a crown is primary; None where nothing is known of them."""
    numbers = believed(crown)
    milk = sum(p for number, p in numbers.items() if is_primary(number))
    rest = sum(
        p
        for number, p in numbers.items()
        if not is_primary(number) and number % 10 <= PRIMARY_PLACES
    )
    if milk + rest < LEAST_SHARE:
        return None
    return float(np.log(max(milk, LEAST_PROBABILITY) / max(rest, LEAST_PROBABILITY)))


def said_numbers(dentitions: Iterable[Dentition]) -> dict[int, bool]:
    """Permanent number -> whether a person has said that a primary tooth stands there."""
    return {
        permanent_of(crown.number): is_primary(crown.number)
        for dentition in dentitions
        for crown in dentition.all_crowns
        if number_is_said(crown) and crown.number % 10 <= PRIMARY_PLACES
    }


def refuse_two_in_one_place(dentitions: Iterable[Dentition], names: Iterable[str]) -> None:
    """Refuse that a primary tooth and its successor are said to stand in one place.

    Args:
        dentitions: those of one mouth.
        names: of their photographs.

    Raises:
        RequestError: with both and their photographs.
    """
    said: dict[int, tuple[int, str]] = {}
    for dentition, name in zip(dentitions, names, strict=True):
        for number in (crown.number for crown in dentition.all_crowns if number_is_said(crown)):
            other, there = said.setdefault(permanent_of(number), (number, name))
            if other != number:
                raise RequestError(
                    f"The tooth numbers given contradict each other: {other} in {there}, {number} "
                    f"in {name}. A primary tooth and the one that follows it have one place in the "
                    "row: say the same of it everywhere; where both stand, give one its number and "
                    "remove the other."
                )


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


def molars_cost(primary: frozenset[int], first_molars: float, second_molars: float) -> float:
    """What the permanent molars seen speak against a set of primary teeth (evidence).

    Args:
        primary: the set.
        first_molars, second_molars: how many are seen.
    """
    cost = LATE_MOLAR_COST * second_molars if primary else 0.0
    if any(tooth % 10 == 1 for tooth in primary):
        cost += EARLY_MOLAR_COST * first_molars
    return cost


def cheapest_left(
    looks: Mapping[int, float], said: Mapping[int, bool],
    cost_of: Callable[[frozenset[int]], float],
) -> tuple[float, frozenset[int]]:  # fmt: skip
    """The set of primary teeth left that costs least, and what it costs.

    Args:
        looks: as of `looks_cost`.
        said: permanent number -> whether a person has said that a primary tooth stands there.
        cost_of: what speaks against a set (evidence), its order apart.
    """
    found: list[tuple[float, frozenset[int]]] = []
    for upper, lower in product(LEFT, LEFT):
        left = {"upper": upper, "lower": lower}
        teeth = {t for jaw in JAWS for t in teeth_of(jaw) if t % 10 in left[jaw]}
        chosen = frozenset(t for t in teeth if said.get(t, True)) | {t for t in said if said[t]}
        order = APART_COST * abs(len(upper) - len(lower))
        order += CHANGING_COST * sum(0 < len(jaw) < PRIMARY_PLACES for jaw in (upper, lower))
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


def odds_of_left(
    looks: Mapping[int, float], said: Mapping[int, bool],
    shape_cost: Callable[[frozenset[int]], float],
) -> dict[int, float]:  # fmt: skip
    """Permanent number -> log odds that a primary tooth stands there, of all that have one.

    Args:
        looks, said: as of `cheapest_left`.
        shape_cost: what where the teeth stand speaks against a set (evidence).
    """

    def cost_of(teeth: frozenset[int]) -> float:
        return looks_cost(looks, teeth) + shape_cost(teeth)

    _, primary = cheapest_left(looks, said, cost_of)
    now = cost_of(primary)
    result = {}
    for tooth in (t for jaw in JAWS for t in teeth_of(jaw) if t % 10 <= PRIMARY_PLACES):
        sure = (OUT_OF_ORDER_COST + cost_of(primary ^ {tooth}) - now) / 2
        if tooth in said:
            sure = -np.log(LEAST_PROBABILITY)
        result[tooth] = float(max(sure, 0.0) * (1 if tooth in primary else -1))
    return result
