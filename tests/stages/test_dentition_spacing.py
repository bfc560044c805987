"""Spaces between neighbours tell which teeth are missing."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS, teeth_of
from stages.dentition.spacing import spacing_cost, spacing_evidence, textbook_distances, unit_of
from stages.dentition.tooth_rows import POSITIONS, row_probabilities

UNIT = 0.01


def places_of(positions: list[int], spaces: float = 1.0) -> np.ndarray:
    """[n, 3] middles of teeth in a straight row, `spaces` times as far apart as a textbook's."""
    along = textbook_distances("upper")[0, positions] * UNIT * spaces
    return np.column_stack([along, np.zeros((len(along), 2))])


def looks_of(positions: list[int], shift: int, share: float) -> np.ndarray:
    """[n, 14] log probabilities: each its own position, or with `share` another."""
    looks = np.full((len(positions), POSITIONS), 1e-3)
    for k, position in enumerate(positions):
        looks[k, position] = 1 - share
        looks[k, position + shift] = share
    return np.log(looks / looks.sum(1, keepdims=True))


def test_distances_are_sums_of_widths() -> None:
    distances = textbook_distances("upper")
    row = teeth_of("upper")
    assert distances[row.index(11), row.index(21)] == pytest.approx(8.5)
    assert distances[row.index(12), row.index(21)] == pytest.approx(6.5 / 2 + 8.5 + 8.5 / 2)
    np.testing.assert_allclose(distances, -distances.T)


def test_the_unit_is_that_of_neighbours_alone() -> None:
    positions = [2, 3, 5, 6, 7, 8]
    places = places_of(positions)
    found = unit_of([("upper", places, np.array(positions))])
    assert found == pytest.approx(UNIT)
    nothing = np.array([POSITIONS, 3, POSITIONS, 6, POSITIONS, 8])
    assert unit_of([("upper", places, nothing)]) is None


@pytest.mark.parametrize("share", [0.5, 0.7])
def test_a_gap_is_a_missing_tooth(share: float) -> None:
    """All behind it look rather like the tooth before them."""
    positions = [2, 3, 4, 5, 6, 8, 9, 10, 11]  # 21 is missing
    looks = looks_of(positions, -1, share)
    looks[:5] = looks_of(positions[:5], 1, 0.05)
    places = places_of(positions)
    blind = row_probabilities(looks)
    assert blind.argmax(1).tolist() != positions
    told = row_probabilities(looks, spacing=spacing_evidence("upper", places, UNIT))
    assert told.argmax(1).tolist() == positions


def test_where_a_gap_has_closed_looks_decide() -> None:
    positions = [2, 3, 5, 6, 7, 8, 9]  # 14 is missing, its neighbours touch
    places = places_of([2, 3, 4, 5, 6, 7, 8])
    looks = 3 * looks_of(positions, -1, 0.01)  # as three photographs see it
    spacing = spacing_evidence("upper", places, UNIT)
    told = row_probabilities(looks, spacing=spacing)
    assert told.argmax(1).tolist() == positions


def test_spaces_of_the_textbook_change_nothing() -> None:
    positions = list(range(1, 12))
    looks = looks_of(positions, 1, 0.2)
    spacing = spacing_evidence("upper", places_of(positions, 1.1), UNIT)
    blind = row_probabilities(looks)
    told = row_probabilities(looks, spacing=spacing)
    assert told.argmax(1).tolist() == blind.argmax(1).tolist() == positions


@pytest.mark.parametrize("unit", [1.0, 0.04])
def test_distances_tell_a_childs_row_from_a_grown_ups(unit: float) -> None:
    """Whatever a millimetre is in the world."""
    rng = np.random.default_rng(3)
    milk = frozenset(tooth for jaw in JAWS for tooth in teeth_of(jaw) if tooth % 10 <= 5)
    half = frozenset(tooth for tooth in milk if tooth % 10 >= 3)
    positions = np.arange(1, 13)
    for true in (frozenset(), half, milk):
        rows = []
        for jaw in JAWS:
            along = textbook_distances(jaw, true)[0, positions]
            along = np.cumsum(np.diff(along, prepend=0) * np.exp(rng.normal(scale=0.1, size=12)))
            places = np.stack([unit * along, np.zeros(12), np.zeros(12)], 1)
            rows.append((jaw, places, positions))
        costs = {primary: spacing_cost(rows, primary) for primary in (frozenset(), half, milk)}
        assert min(costs, key=lambda primary: costs[primary]) == true
        assert sorted(costs.values())[1] > costs[true] + 5
    assert spacing_cost([("upper", np.zeros((1, 3)), np.array([4]))], milk) == 0
