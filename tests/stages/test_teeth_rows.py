"""The order of the teeth along a row, beside a count of all orders there are."""

from __future__ import annotations

from itertools import combinations, pairwise, product

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import teeth_of
from stages.dentition.tooth_rows import (
    LEAST_BY_LOOKS,
    NO_TOOTH,
    NO_TOOTH_COST,
    POSITIONS,
    SKIPPED_COST,
    best_rows,
    position_evidence,
    row_probabilities,
)
from stages.teeth.numbers import looks


def evidence(seed: int, count: int) -> np.ndarray:
    shares = np.random.default_rng(seed).dirichlet(np.full(POSITIONS, 0.5), count)
    return np.log(0.97 * shares + 0.03 / POSITIONS)


def seen(*positions: int, sure: float = 0.9) -> np.ndarray:
    """[n, 14] crowns that look like these positions."""
    shares = np.full((len(positions), POSITIONS), (1 - sure) / (POSITIONS - 1))
    shares[np.arange(len(positions)), positions] = sure
    return np.log(shares)


def every_row(crowns: np.ndarray) -> list[tuple[float, tuple[int, ...]]]:
    """All labellings with their costs, straight from the definition of the chain."""
    rows = []
    count = len(crowns)
    for named in product((False, True), repeat=count):
        for chosen in combinations(range(POSITIONS), sum(named)):
            places = iter(chosen)
            labels = tuple(next(places) if is_named else NO_TOOTH for is_named in named)
            cost = sum(
                -crowns[k, p] if p != NO_TOOTH else NO_TOOTH_COST + np.log(POSITIONS)
                for k, p in enumerate(labels)
            )
            skipped = sum(b - a - 1 for a, b in pairwise(chosen))
            rows.append((float(cost + SKIPPED_COST * skipped), labels))
    return sorted(rows)


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 2), (2, 3), (3, 4)])
def test_best_rows_are_the_best_of_all(seed: int, count: int) -> None:
    crowns = evidence(seed, count)
    wanted = every_row(crowns)[:12]
    found = best_rows(crowns, 12)
    np.testing.assert_allclose([c for c, _ in found], [c for c, _ in wanted], rtol=1e-12)
    assert [labels for _, labels in found] == [labels for _, labels in wanted]


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 2), (2, 3), (3, 4)])
def test_probabilities_are_the_sums_over_all_rows(seed: int, count: int) -> None:
    crowns = evidence(seed, count)
    rows = every_row(crowns)
    weights = np.exp([-cost for cost, _ in rows])
    expected = np.zeros((count, POSITIONS + 1))
    for weight, (_, labels) in zip(weights, rows, strict=True):
        expected[np.arange(count), labels] += weight  # NO_TOOTH is the last column
    shares = row_probabilities(crowns)
    np.testing.assert_allclose(shares, expected / weights.sum(), atol=1e-9)


def test_probabilities_sum_to_one_in_long_rows() -> None:
    for count in (1, 8, 14, 20):
        shares = row_probabilities(evidence(count, count))
        np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-9)
        assert shares.min() >= -1e-12


def test_no_crowns_at_all() -> None:
    shares = row_probabilities(np.zeros((0, POSITIONS)))
    assert shares.shape == (0, POSITIONS + 1)
    assert best_rows(np.zeros((0, POSITIONS)), 5) == [(0.0, ())]


def test_order_tells_apart_what_looks_do_not() -> None:
    """Six front teeth that look like either side: only one order is from right to left."""
    sides = np.log(np.full((6, POSITIONS), 1e-3))
    for k, position in enumerate((4, 5, 6, 7, 8, 9)):
        sides[k, position] = sides[k, 13 - position] = np.log(0.49)
    shares = row_probabilities(sides)
    assert shares.argmax(axis=1).tolist() == [4, 5, 6, 7, 8, 9]
    assert shares.max(axis=1).min() > 0.95


def test_a_missing_tooth_leaves_the_others_in_their_places() -> None:
    shares = row_probabilities(seen(4, 5, 6, 8, 9))
    assert shares.argmax(axis=1).tolist() == [4, 5, 6, 8, 9]
    assert best_rows(seen(4, 5, 6, 8, 9), 1)[0][1] == (4, 5, 6, 8, 9)
    # One crown that looks like its neighbour's number is no gap: the others outvote it.
    assert best_rows(seen(4, 5, 7, 7, 8, 9), 1)[0][1] == (4, 5, 6, 7, 8, 9)


def test_a_false_crown_gets_no_number() -> None:
    labels = best_rows(seen(4, 5, 6, 6, 7, 8, 9, sure=0.98), 1)[0][1]
    assert labels in ((4, 5, 6, NO_TOOTH, 7, 8, 9), (4, 5, NO_TOOTH, 6, 7, 8, 9))
    shares = row_probabilities(seen(4, 5, 6, 6, 7, 8, 9, sure=0.98))
    assert shares[2:4, POSITIONS].sum() == pytest.approx(1, abs=0.1)
    assert shares[[0, 1, 4, 5, 6], [4, 5, 7, 8, 9]].min() > 0.95


def test_evidence_counts_primary_teeth_in_their_places_and_forgets_the_other_jaw() -> None:
    order = teeth_of("upper")
    values = position_evidence({11: 0.3, 51: 0.3, 12: 0.4, 31: 5.0}, "upper")
    shares = np.exp(values)
    assert shares[order.index(11)] == pytest.approx(0.6, abs=0.02)
    assert shares[order.index(12)] == pytest.approx(0.4, abs=0.02)
    assert shares.sum() == pytest.approx(1)
    assert shares.min() == pytest.approx(LEAST_BY_LOOKS)
    np.testing.assert_allclose(np.exp(position_evidence({}, "upper")), 1 / POSITIONS)
    np.testing.assert_allclose(np.exp(position_evidence({48: 1.0}, "lower")), 1 / POSITIONS)


def test_looks_are_probabilities_of_numbers() -> None:
    place = np.log([0.7, 0.1, 0.1, 0.04, 0.03, 0.01, 0.01, 0.01])
    found = looks(2.0, -3.0, place, "lower")
    assert sum(found.values()) == pytest.approx(1)
    assert max(found, key=lambda tooth: found[tooth]) == 31
    assert found[31] / found[41] == pytest.approx(np.exp(2.0))
    assert found[71] / found[31] == pytest.approx(np.exp(-3.0))
    assert {tooth // 10 for tooth in found} == {3, 4, 7, 8}
    assert max(looks(-9.0, 9.0, place, "upper").items(), key=lambda kv: kv[1])[0] == 51
    wisdom = np.log([0.01] * 7 + [0.93])
    assert max(looks(9.0, -9.0, wisdom, "upper").items(), key=lambda kv: kv[1])[0] == 27
