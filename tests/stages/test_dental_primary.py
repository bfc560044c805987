"""Which primary teeth are left, by the looks of the crowns."""

from __future__ import annotations

from stages.dentition.changing_teeth import (
    CONTRAST,
    EVEN_ODDS,
    LEFT,
    OUT_OF_ORDER_COST,
    looks_cost,
    molars_cost,
    odds_of_left,
)
from stages.init.dental.numbering.primary import ALL_PRIMARY

SEEN = tuple(sorted(ALL_PRIMARY))


def looks(milk: set[int], level: float) -> dict[int, float]:
    """Log odds of all teeth: those of primary ones at a level, of the others lower by usual."""
    return {tooth: level - (tooth not in milk) * CONTRAST for tooth in SEEN}


def cheapest(found: dict[int, float], among: list[set[int]]) -> set[int]:
    return min(among, key=lambda teeth: looks_cost(found, frozenset(teeth)))


def places(*left: int) -> set[int]:
    return {tooth for tooth in SEEN if tooth % 10 in left}


SETS = [places(*left) for left in LEFT]


def test_a_mouth_of_one_set_is_told_by_the_usual_odds() -> None:
    """The reader has seen few children: theirs look permanent to it, but less than others."""
    for level in (-4.5, -1.5, 7.0):
        assert cheapest(looks(set(SEEN), level), SETS) == set(SEEN)
    for level in (-4.5, -1.5):
        assert cheapest(looks(set(), level), SETS) == set()


def test_a_changing_mouth_is_told_by_the_contrast_within() -> None:
    """Whatever its primary teeth look like, in every order that there is."""
    for level in (-3.0, 0.0, 6.0):
        for milk in SETS:
            if set() < milk < set(SEEN):
                assert cheapest(looks(milk, level), SETS) == milk, (level, milk)


def test_one_tooth_out_of_order_is_worth_its_cost() -> None:
    milk = places(3, 4, 5) - {34}
    found = looks(milk, 0.0)
    gain = looks_cost(found, frozenset(places(3, 4, 5))) - looks_cost(found, frozenset(milk))
    assert gain > OUT_OF_ORDER_COST
    # A grown-up kept 75: its successor never came.
    kept = looks({35}, -1.0)
    assert looks_cost(kept, frozenset()) - looks_cost(kept, frozenset({35})) > OUT_OF_ORDER_COST


def test_a_tooth_that_looks_a_little_otherwise_is_not() -> None:
    found = looks(set(), -1.0)
    found[13] += 0.5 * CONTRAST
    gain = looks_cost(found, frozenset()) - looks_cost(found, frozenset({13}))
    assert gain < OUT_OF_ORDER_COST


def test_looks_that_say_nothing_cost_nothing() -> None:
    assert looks_cost({}, frozenset({15})) == 0
    even = dict.fromkeys(SEEN, EVEN_ODDS)
    assert looks_cost(even, frozenset()) == looks_cost(even, ALL_PRIMARY) == 0


def anywhere(primary: frozenset[int]) -> float:
    """Where the teeth stand says nothing."""
    return 0.0


def told(odds: dict[int, float]) -> set[int]:
    return {tooth for tooth, value in odds.items() if value > 0}


def test_looks_and_order_together_tell_every_tooth() -> None:
    """Of a tooth of which nothing is seen, the order tells."""
    milk = places(3, 4, 5)
    found = looks(milk, -3.0)
    del found[14], found[41]
    assert told(odds_of_left(found, {}, anywhere)) == milk
    assert told(odds_of_left(looks(set(), -1.5), {}, anywhere)) == set()
    assert told(odds_of_left(looks({35}, -1.0), {}, anywhere)) == {35}
    odds = odds_of_left(found, {}, anywhere)
    assert abs(odds[14]) < abs(odds[24]), "it is less sure"


def test_what_a_person_said_of_a_tooth_stands() -> None:
    odds = odds_of_left(looks(set(SEEN), -3.0), {15: False, 45: True}, anywhere)
    assert told(odds) == set(SEEN) - {15}
    assert min(-odds[15], odds[45]) > 9


def test_second_molars_speak_against_primary_teeth() -> None:
    """They come when the last of those go, and first molars when the central incisors do."""
    childs = looks(set(SEEN), -3.0)

    def told_beside(first: float, second: float) -> set[int]:
        beside = odds_of_left(childs, {}, lambda primary: molars_cost(primary, first, second))
        return told(beside)

    assert told_beside(0, 0) == told_beside(4, 1) == set(SEEN)
    assert told_beside(12, 12) == set()
