"""Teeth across the mouth, seen through the gap of an open bite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.teeth import Dentition
from stages.dentition.crowns import Outline, dentition_of, outline_of, with_outlines
from stages.dentition.far_side import far_side, far_side_apart
from tests.stages.crowns_case import MIDDLE, SIZE, mouth, shape, turned

APART = 60.0


def open_bite(
    along: float = -3.0, across: float = 0.0, jaw: Jaw = "upper", number: int = 0,
    degrees: float = 0.0,
) -> Dentition:  # fmt: skip
    """Two rows that do not meet, and a crown between them.

    Args:
        along, across: where its middle is from the picture's middle.
        jaw, number: what it was taken for.
    """
    low = shape(40.0, jaw) * [1, 0.5]
    points = low - (low.min(0) + low.max(0)) / 2 + MIDDLE + [along, across]
    between = Outline(turned(points, degrees), jaw, 0.9, {}, number=number, doubt=0.5)
    rows = mouth(degrees=degrees, apart=APART)
    return dentition_of([*rows, between], "000", SIZE, "right", roll=np.radians(degrees))


@pytest.mark.parametrize("jaw", ["upper", "lower"])
@pytest.mark.parametrize("degrees", [0.0, 25.0])
def test_a_crown_between_the_rows_is_none_of_them(jaw: Jaw, degrees: float) -> None:
    seen = open_bite(jaw=jaw, degrees=degrees)
    found = {name: far_side(seen, name) for name in ("upper", "lower")}
    assert found[jaw].sum() == 1
    assert not found["lower" if jaw == "upper" else "upper"].any()
    near, behind = far_side_apart(seen)
    assert [crown.jaw for crown in behind] == [jaw]
    assert len(near) == len(seen.all_crowns) - 1
    assert all(crown.number for crown in near)


def test_what_has_a_number_stays() -> None:
    assert not far_side(open_bite(number=12), "upper").any()


def test_what_reaches_the_gum_stays() -> None:
    # As far up as its neighbours: a crown that overlaps them, of which nobody can say the number.
    assert not far_side(open_bite(across=-APART / 2 - 50), "upper").any()


def test_what_ends_the_row_stays() -> None:
    assert not far_side(open_bite(along=-260.0), "upper").any()


def test_rows_of_nothing_but_unknown_crowns_stay() -> None:
    seen = open_bite()
    unknown = replace(seen, upper=tuple(replace(crown, number=0) for crown in seen.upper))
    assert not far_side(unknown, "upper").any()
    assert not far_side(replace(seen, upper=()), "upper").any()


def test_neighbours_meet_where_they_would_without_it() -> None:
    seen = open_bite()
    place = next(k for k, crown in enumerate(seen.upper) if not crown.number)
    assert seen.upper[place - 1].papilla_right is None, "it stands between them"
    alone = with_outlines(seen, [outline_of(crown) for crown in far_side_apart(seen)[0]])
    clean = dentition_of(mouth(apart=APART), "000", SIZE, "right", roll=0.0)
    for mine, true in zip(alone.all_crowns, clean.all_crowns, strict=True):
        for side in ("papilla_left", "papilla_right"):
            found, wanted = getattr(mine, side), getattr(true, side)
            assert (found is None) == (wanted is None)
            if wanted is not None:
                np.testing.assert_allclose(found, wanted, atol=0.5)
