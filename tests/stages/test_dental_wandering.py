"""Where neighbours meet and part wanders with the side that one looks from."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS
from stages.init.dental.landmarks import Landmark
from stages.init.dental.numbering.sightings import (
    EMBRASURE_WANDERS,
    PAPILLA_WANDERS,
    SightingCache,
    seen_rows,
)
from stages.init.dental.template import facing_yaws, landmark_names
from tests import teeth_case

NAMES = landmark_names()
LABELS = (tuple(range(4, 10)), tuple(range(4, 10)))


def facing(kind: str, tooth: int, neighbour: int = 0) -> float:
    return float(facing_yaws()[NAMES.index(Landmark(kind, tooth, neighbour))])  # type: ignore[arg-type]


@pytest.mark.parametrize("right", [1, 4])
def test_teeth_face_outwards(right: int) -> None:
    left = {1: 2, 4: 3}[right]
    assert facing("papilla", *((11, 21) if right == 1 else (41, 31))) == pytest.approx(0, abs=1)
    yaws = [facing("zenith", 10 * left + place) for place in range(1, 7)]
    assert np.all(np.diff(yaws) > 0)
    assert 60 < yaws[-1] < 95
    mirrored = [facing("zenith", 10 * right + place) for place in range(1, 7)]
    np.testing.assert_allclose(mirrored, np.negative(yaws), atol=1e-9)


def test_what_is_seen_along_the_row_is_taken_back() -> None:
    rows = seen_rows(teeth_case.dentition("000", "front"))
    cache = SightingCache([rows])
    in_front, aside = (cache.collect([0], [LABELS], [yaw]) for yaw in (0.0, 90.0))
    np.testing.assert_array_equal(in_front.landmark, aside.landmark)
    np.testing.assert_array_equal(in_front.pixels[:, 0], aside.pixels[:, 0])
    moved = (in_front.pixels - aside.pixels)[:, 1] / rows[0].band
    kinds = np.array([NAMES[k].kind for k in in_front.landmark])
    lower = np.array([NAMES[k].tooth > 30 for k in in_front.landmark])
    for kind, wanders in (("papilla", PAPILLA_WANDERS), ("embrasure", EMBRASURE_WANDERS)):
        for name, sign in zip(JAWS, (1, -1), strict=True):
            mine = moved[(kinds == kind) & (lower == (name == "lower"))]
            if kind == "embrasure" and name == "lower":
                assert not len(mine), "the upper crowns overlap"
                continue
            # From a quarter of a turn aside what faced the camera is seen along the row.
            ahead = facing_yaws()[in_front.landmark[(kinds == kind) & (lower == (name == "lower"))]]
            wanted = -2 * sign * wanders * np.cos(2 * np.radians(ahead))
            np.testing.assert_allclose(mine, wanted, atol=1e-9)
    assert not moved[(kinds == "zenith") | (kinds == "tip")].any()


def test_the_rows_as_they_were_seen_stay() -> None:
    rows = seen_rows(teeth_case.dentition("000", "front"))
    cache = SightingCache([rows])
    before = cache.of_row(0, 0, LABELS[0])[1].copy()
    cache.collect([0], [LABELS], [10.0])
    np.testing.assert_array_equal(cache.of_row(0, 0, LABELS[0])[1], before)
