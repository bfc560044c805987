"""Crowns that were read as two: which may be, how they are joined, and how a row names them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement, pairwise

import numpy as np
import pytest

from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.corrections import area, split_polygon
from stages.dentition.crowns import dentition_of, outline_of
from stages.dentition.parts import joined_parts, perhaps_one
from stages.dentition.row_edits import is_ordered, joining_edits, row_edits
from stages.dentition.tooth_rows import (
    NO_TOOTH,
    PART_COST,
    POSITIONS,
    SKIPPED_COST,
    best_rows,
)
from stages.init.dental.mirror_images import Turned
from stages.init.dental.numbering.arch import ArchOptions, fit_arch
from stages.init.dental.numbering.labellings.scorer import (
    row_defects,
)
from stages.init.dental.numbering.sightings import SightingCache, row_landmarks, seen_rows
from stages.init.dental.reconstruct import with_whole_crowns
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.template import landmark_names
from tests import teeth_case
from tests.stages.mouth_case import mouth_case, true_numbers

HALF = teeth_case.SIDE / 2


def halved(place: int = 2, gap: float = 0.0) -> Dentition:
    """A row of boxes, one of the upper ones cut from top to bottom."""
    whole = teeth_case.dentition("000", "front")
    outlines = [outline_of(crown) for crown in whole.all_crowns]
    x, _ = teeth_case.middle(place, "upper")
    parts = split_polygon(outlines[place].polygon, np.array([x, 0.0]), np.array([x, 400.0]))
    aside = [part + np.array([np.sign(part[:, 0].mean() - x) * gap / 2, 0]) for part in parts]
    outlines[place : place + 1] = [replace(outlines[place], polygon=part) for part in aside]
    return dentition_of(outlines, whole.name, whole.size, whole.kind, roll=0.0)


def halves(**options: float) -> tuple[Crown, Crown]:
    first, second = halved(**options).upper[2:4]  # type: ignore[arg-type]
    return first, second


def test_neighbours_that_touch_and_look_alike_may_be_one() -> None:
    first, second = halves()
    assert perhaps_one(first, second)
    assert perhaps_one(second, first)
    side = teeth_case.dentition("000", "front").upper[:3]
    assert not any(perhaps_one(*pair) for pair in pairwise(side)), "they look like two teeth"


def test_what_is_apart_or_looks_like_nothing_is_not_one() -> None:
    first, second = halves()
    assert not perhaps_one(first, replace(second, numbers={}))
    assert not perhaps_one(first, replace(second, outline=np.zeros((0, 2))))
    assert perhaps_one(*halves(gap=1.0))
    assert not perhaps_one(*halves(gap=HALF / 2))
    # A person's word is the last one.
    assert not perhaps_one(replace(first, number=12, doubt=0.0), second)
    said = [replace(crown, number=12, doubt=0.0) for crown in (first, second)]
    assert perhaps_one(said[0], said[1])


@pytest.mark.parametrize("gap", [0.0, 1.5])
def test_parts_with_one_number_become_one_crown(gap: float) -> None:
    parts, whole = halved(gap=gap), teeth_case.dentition("000", "front")
    rows = (13, 12, 11, 11, 21, 22, 23), (43, 42, 41, 31, 32, 33)
    made = joined_parts(parts, rows)
    assert [len(row) for row in (made.upper, made.lower)] == [6, 6]
    for mine, true in zip(made.all_crowns, whole.all_crowns, strict=True):
        np.testing.assert_allclose(mine.zenith, true.zenith, atol=1 + gap)
        assert mine.width == pytest.approx(true.width, abs=1 + gap)
    joined = made.upper[2]
    assert area(joined.outline) == pytest.approx(area(whole.upper[2].outline), rel=0.02 + gap / 15)
    assert joined.numbers == pytest.approx(whole.upper[2].numbers)
    assert joined.papilla_left is not None
    assert joined.papilla_right is not None


def test_rows_without_parts_stay_as_they_are() -> None:
    parts = halved()
    rows = (13, 12, 0, 0, 21, 22, 23), (43, 42, 41, 31, 32, 33)
    assert joined_parts(parts, rows) is parts


def test_edits_join_two_crowns_and_take_them_apart() -> None:
    edits = set(joining_edits((3, 4, 5, 6, 7), 1))
    assert {(3, 4, 4, 6, 7), (3, 4, 4, 5, 6), (4, 5, 5, 6, 7), (3, 5, 5, 6, 7)} <= edits
    assert (3, 4, 4, 5, 6) in row_edits((3, 4, 5, 6, 7), {1})
    assert (3, 4, 4, 5, 6) not in row_edits((3, 4, 5, 6, 7))
    assert (3, 4, 5, 6, 7) in row_edits((3, 4, 4, 5, 6), {1})
    # A crown without a number and one with a wrong one are both parts of the tooth between.
    assert (NO_TOOTH, 1, 1, 2, 3) in row_edits((NO_TOOTH, NO_TOOTH, 0, 2, 3), {1})


def test_only_two_neighbours_are_parts_of_one_crown() -> None:
    assert is_ordered((3, 4, 4, 5), {1})
    assert not is_ordered((3, 4, 4, 5), {2})
    assert not is_ordered((3, 4, 4, 4, 5), {1, 2})
    assert not is_ordered((3, 4, NO_TOOTH, 4, 5), {1, 2})
    assert is_ordered((3, NO_TOOTH, NO_TOOTH, 4), ())


@pytest.mark.parametrize(("seed", "count", "wholes"), [(0, 3, {0}), (1, 3, {0, 1}), (2, 4, {1})])
def test_best_rows_with_parts_are_the_best_of_all(seed: int, count: int, wholes: set[int]) -> None:
    crowns = np.log(np.random.default_rng(seed).dirichlet(np.full(POSITIONS, 0.4), count) + 1e-3)
    crowns[1] = crowns[0] + 0.1
    rows = []
    for labels in combinations_with_replacement(range(POSITIONS), count):
        if is_ordered(labels, wholes):
            parts = sum(a == b for a, b in pairwise(labels))
            skipped = sum(max(b - a - 1, 0) for a, b in pairwise(labels))
            cost = PART_COST * parts + SKIPPED_COST * skipped
            rows.append((cost - crowns[np.arange(count), labels].sum(), labels))
    wanted = sorted(rows)[:8]
    found = [row for row in best_rows(crowns, 400, wholes) if NO_TOOTH not in row[1]][:8]
    assert [labels for _, labels in found] == [labels for _, labels in wanted]
    np.testing.assert_allclose([c for c, _ in found], [c for c, _ in wanted], rtol=1e-12)


def test_parts_show_the_landmarks_of_the_whole() -> None:
    parts, whole = (seen_rows(d)[0] for d in (halved(), teeth_case.dentition("000", "front")))
    assert 2 in parts.wholes
    mine = row_landmarks(parts, (4, 5, 6, 6, 7, 8, 9))
    true = row_landmarks(whole, (4, 5, 6, 7, 8, 9))
    assert mine[0] == true[0]
    # Boxes end flat: where neighbours part at their edge lies between the tips of the parts.
    sharp = [landmark_names()[k].kind != "embrasure" for k in mine[0]]
    np.testing.assert_allclose(np.array(mine[1])[sharp], np.array(true[1])[sharp], atol=0.5)
    sightings = SightingCache([(parts, parts)])
    # A zenith, a tip, a papilla and an embrasure are not seen where the parts meet.
    assert sightings.unused(0, 0, (4, 5, 6, 6, 7, 8, 9)) == 4
    assert sightings.unused(0, 0, (3, 4, 5, 6, 7, 8, 9)) == 0
    assert seen_rows(dentition_of([], "none", (9, 9), "front"))[0].landmark_count == 0
    assert row_defects((4, 5, 6, 6, 7, 8, 9), frozenset()) == 1
    assert row_defects((4, 5, 6, 7, 8, 9), frozenset()) == 0


def test_the_fit_names_a_whole_crown_once() -> None:
    placed = PlacedView(
        np.eye(4), 900.0, "frontal", (13, 12, 11, 11, 21, 22, 23), (0, 0, 41, 31, 32, 33), 1.0,
        (0.1, 0.1, 0.3, 0.2, 0.1, 0.1, 0.1), (1.0, 1.0, 0.1, 0.1, 0.1, 0.1),
    )  # fmt: skip
    view = teeth_case.views().views[0]
    fit = ArchFit((placed,), {}, {}, 10.0)
    turned, full = with_whole_crowns(Turned([view], [halved()], fit), [halved()])
    (found,) = turned.fit.views
    assert found is not None
    assert found.upper == (13, 12, 11, 21, 22, 23)
    assert found.upper_doubts == (0.1, 0.1, 0.2, 0.1, 0.1, 0.1)
    assert found.lower == placed.lower, "crowns without a number are no parts of one"
    for dentition in (turned.dentitions[0], full[0]):
        assert dentition is not None
        assert [len(row) for row in (dentition.upper, dentition.lower)] == [6, 6]


def test_a_person_may_say_that_two_crowns_are_one() -> None:
    parts = halved()
    said = [
        replace(crown, number=11, doubt=0.0) if k in (2, 3) else crown
        for k, crown in enumerate(parts.upper)
    ]
    assert seen_rows(parts)[0].said_wholes == set()
    assert seen_rows(replace(parts, upper=tuple(said)))[0].said_wholes == {2}
    one = replace(parts, upper=(*said[:3], *parts.upper[3:]))
    assert seen_rows(one)[0].said_wholes == set()


def mouth(said: bool) -> tuple[list[Dentition], ArchFit, list[dict[str, tuple[int, ...]]]]:
    """Three photographs of a mouth, a tooth within a row of one of them read as two crowns; with
    both numbers said, or by looks."""
    photographed = mouth_case(10, dark=True, arch_power=2.5, arch_width=1.04, size=1.0)
    dentitions = photographed.dentitions()
    side = dentitions[0]
    whole = outline_of(side.upper[1])
    x = float(whole.polygon[:, 0].mean())
    parts = split_polygon(whole.polygon, np.array([x, 0.0]), np.array([x + 5, 400.0]))
    outlines = [outline_of(crown) for crown in side.all_crowns if crown is not side.upper[1]]
    if said:
        number = max(whole.numbers, key=lambda tooth: whole.numbers[tooth])
        whole = replace(whole, number=number, doubt=0.0)
    outlines += [replace(whole, polygon=part) for part in parts]
    dentitions[0] = dentition_of(outlines, side.name, side.size, side.kind)
    views = photographed.views.views
    fit = fit_arch(
        list(dentitions), [v.image for v in views], [v.valid() for v in views], [None] * 3,
        ArchOptions(dense_rounds=0, rows_tried=8), 1, lambda *_: None,
    )  # fmt: skip
    turned, _ = with_whole_crowns(Turned(list(views), list(dentitions), fit), list(dentitions))
    joined = [dentition for dentition in turned.dentitions if dentition]
    truth = [true_numbers(p, d) for p, d in zip(photographed.photos, joined, strict=True)]
    return joined, turned.fit, truth  # type: ignore[return-value]


@pytest.mark.parametrize("said", [False, True], ids=["by looks", "said"])
def test_a_crown_that_was_read_as_two_gets_its_number(said: bool) -> None:
    joined, fit, truth = mouth(said)
    placed = fit.views[0]
    assert placed is not None
    assert tuple(fit.number_of(tooth) for tooth in placed.upper) == truth[0]["upper"]
    assert len(joined[0].upper) == len(placed.upper)
