"""Jaws that stood otherwise at one of two visits: no tooth moved for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import is_upper
from pipeline.errors import ReconstructionError
from pipeline.studies.register import comparing
from pipeline.studies.register.comparing import Comparison, compare_visits
from pipeline.studies.register.jaws import of_jaw, stand_otherwise
from pipeline.studies.register.visit import Visit, teeth_points
from pipeline.studies.register.writing import described, warning
from tests.studies.register_case import LOWER, MOVED, motion, toy_centres, toy_motions, toy_visit

FRONT = (13, 12, 11, 21, 22, 23, 43, 42, 41, 31, 32, 33)
#: Where the lower jaw went, mm: teeth that are apart by so little were taken for closed ones.
WAY = (0.2, -1.5, -0.4)


def small(visit: Visit, teeth: tuple[int, ...] = FRONT) -> Visit:
    """Two photographs of front teeth: all that is needed here."""
    looks = tuple(
        replace(look, labels=np.where(np.isin(look.labels, teeth), look.labels, 0).astype(np.uint8))
        for look in visit.looks[1:3]
    )
    return Visit(visit.name, looks, teeth_points(looks))


@pytest.fixture(scope="module")
def closed() -> Visit:
    return small(toy_visit("closed"))


@pytest.fixture(scope="module")
def opened() -> Visit:
    """Another visit: the jaws apart, and tooth 12 has moved."""
    centres = toy_centres()
    motions = {n: motion(centres[n], WAY, (0, 0, 0)) for n in LOWER}
    return small(toy_visit("opened", motions | {12: toy_motions()[12]}, turn=3.0))


@pytest.fixture(scope="module")
def found(closed: Visit, opened: Visit) -> Comparison:
    return compare_visits(closed, opened)


def test_each_jaw_is_measured_against_its_own_teeth(found: Comparison) -> None:
    """All upper teeth were said to have gone into the gum by 1.5 mm, for certain."""
    assert {tooth.tooth for tooth in found.teeth if tooth.certain} == {12}
    assert set(found.still) == set(FRONT) - {12}
    for tooth in found.teeth:
        if tooth.tooth != 12:
            assert tooth.distance[0] < 0.1, tooth.tooth
    assert found.jaws == ("upper", "lower")
    assert found.jaws_apart == pytest.approx(np.linalg.norm(WAY), abs=0.1)
    assert np.abs(found.first_from_second - np.eye(4)).max() < 0.2  # by the upper one


def test_that_the_jaws_stand_otherwise_is_said(found: Comparison) -> None:
    said = warning(found)
    assert "the lower one is 1.6 mm from there" in said
    assert described(found)["warning"] == said
    one = warning(replace(found, jaws=("upper",), jaws_apart=None))
    assert "only the upper one can be compared" in one


def test_teeth_of_a_jaw_that_cannot_be_compared_are_not_measured(
    closed: Visit, opened: Visit, found: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    def upper_alone(first: Visit, *rest: object) -> Comparison:
        if not any(map(is_upper, first.centres)):
            raise ReconstructionError("its surfaces do not agree")
        return replace(found, teeth=tuple(t for t in found.teeth if is_upper(t.tooth)))

    monkeypatch.setattr(comparing, "_compared", upper_alone)
    half = compare_visits(closed, opened)
    assert half.jaws == ("upper",) and half.jaws_apart is None
    assert half.missing == tuple(sorted(n for n in FRONT if not is_upper(n)))


def test_jaws_that_meet_as_they_did_are_compared_together(closed: Visit) -> None:
    moved = small(toy_visit("second", toy_motions(), turn=3.0))
    assert not stand_otherwise(closed, moved, comparing.LEAST_TEETH)
    assert set(MOVED) & set(closed.centres) == {12}


def test_where_one_jaw_is_hardly_shown_nothing_is_told(closed: Visit, opened: Visit) -> None:
    few = of_jaw(opened, "lower")
    assert not any(map(is_upper, few.centres)) and few.looks[0].labels.max() >= 31
    assert not stand_otherwise(closed, few, comparing.LEAST_TEETH)
