"""Which primary teeth are left, by the looks of the crowns."""

from __future__ import annotations

from stages.init.dental.numbering.primary import (
    ALL_PRIMARY,
    CONTRAST,
    EVEN_ODDS,
    LEFT,
    OUT_OF_ORDER_COST,
    looks_cost,
)

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
