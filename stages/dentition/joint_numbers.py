"""Numbers that placed photographs agree on.

A photograph by itself counts teeth from what it shows: where a crown is hidden, or read as two, all
that follow may carry their neighbours' numbers. Once the photographs are placed, the surface says
which crowns are one tooth; looks of all of them together, the order that all rows have in common,
and the spaces between neighbours number it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import expit, softmax

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import JAWS, PRIMARY_PLACES, WISDOM, Jaw, primary_of, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View
from stages.dentition.changing_teeth import (
    molars_cost,
    odds_of_left,
    primary_odds,
    refuse_two_in_one_place,
    said_numbers,
)
from stages.dentition.same_tooth import Overlaps, crown_overlaps, looking_alike, same_teeth
from stages.dentition.spacing import Row, spacing_cost, spacing_evidence, unit_of
from stages.dentition.tooth_rows import (
    POSITIONS,
    crown_evidence,
    number_is_said,
    row_probabilities,
)

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]
#: Index of a photograph and of a crown among `Dentition.all_crowns` -> number and its doubt.
Numbers = dict[tuple[int, int], tuple[int, float]]
#: Permanent number -> log odds that a primary tooth stands there (`odds_of_left`).
Primary = Mapping[int, float]

#: Photographs of one tooth look alike and err together: n of them count as n to this power.
JOINT_POWER = 0.75
#: A tooth of which so much lies in another's crowns in other photographs, where it lies in any, is
#: a part of that; those must show as much as the whole of it once.
PART, LEAST_SHOWN = 0.8, 1.0
#: Weight of the expected places in the order of a row, against what photographs say.
LOOKS_IN_ORDER = 1e-3
LEAST_DOUBT = 1e-4
#: Number and doubt of what is no tooth.
NONE = 0, 1.0


@dataclass(frozen=True)
class _Tooth:
    """One tooth, or what passes for one.

    Attributes:
        members: indices of its sightings.
        jaw: of all of them.
        centre: [3] median of theirs.
        weight: as how many crowns it counts.
        evidence: [14] log probability of each position by its looks, times that.
        primary: mean log odds of a primary tooth; None where its looks say nothing of it.
    """

    members: list[int]
    jaw: Jaw
    centre: Array
    weight: float
    evidence: Array
    primary: float | None


def agreed_numbers(
    teeth: Teeth,
    views: Sequence[View],
    cameras: Sequence[Camera],
    depths: Sequence[Map],
) -> Teeth:
    """The teeth with the numbers that all placed photographs together give their crowns.

    Photographs that are not placed keep theirs. Crowns that show no tooth of another photograph,
    or whose depth is unknown, are numbered by their photograph's row, in which the others stand
    fast. What a person has said (doubt 0) stays, and counts for the same tooth everywhere.

    Args:
        teeth: as each photograph was read by itself.
        views: the placed photographs.
        cameras, depths: of each, with z-depth [H, W], 0 where unknown.

    Raises:
        RequestError: a primary tooth and its successor are said to stand in one place.
    """
    read = {dentition.name: dentition for dentition in teeth.chosen}
    dentitions = [read.get(view.name) for view in views]
    shown = {v.source_name or v.name: read[v.name] for v in views if v.name in read}
    refuse_two_in_one_place(shown.values(), shown)
    if sum(dentition is not None for dentition in dentitions) < 2:
        return teeth
    overlaps = crown_overlaps(views, dentitions, cameras, depths)
    numbers, primary = _numbers(overlaps, dentitions)
    changed = {
        dentition.name: _renumbered(dentition, v, numbers, primary)
        for v, dentition in enumerate(dentitions)
        if dentition is not None
    }
    views_read = tuple(changed.get(dentition.name, dentition) for dentition in teeth.views)
    return replace(teeth, views=views_read, pictures={})


def _renumbered(dentition: Dentition, view: int, numbers: Numbers, primary: Primary) -> Dentition:
    """A photograph's crowns with the numbers agreed on; the others' by the row that these make."""
    known = [numbers.get((view, index)) for index in range(len(dentition.all_crowns))]
    rows, start = {}, 0
    for jaw in JAWS:
        crowns = dentition.crowns(jaw)
        rows[jaw] = _completed(crowns, known[start : start + len(crowns)], jaw, primary)
        start += len(crowns)
    return replace(dentition, upper=rows["upper"], lower=rows["lower"])


def _completed(
    crowns: Sequence[Crown], known: Sequence[tuple[int, float] | None], jaw: Jaw,
    primary: Primary,
) -> tuple[Crown, ...]:  # fmt: skip
    """One row: crowns without an agreed number stand between those that have one, as sure ones."""
    result = list(crowns)
    row: list[int] = []
    for k, (crown, agreed) in enumerate(zip(crowns, known, strict=True)):
        if agreed is not None and not number_is_said(crown):
            result[k] = replace(crown, number=agreed[0], doubt=agreed[1])
        number = result[k].number
        # parts of one tooth stand in the row once, what is no tooth not at all
        if agreed is None or (number and number not in [result[j].number for j in row]):
            row.append(k)
    fixed = [replace(result[k], doubt=0.0) if known[k] else result[k] for k in row]
    evidence = [crown_evidence(crown, jaw) for crown in fixed]
    shares = row_probabilities(np.array(evidence).reshape(-1, POSITIONS))
    for k, share in zip(row, shares, strict=True):
        if known[k] is None and not number_is_said(crowns[k]):
            place, number, doubt = int(np.argmax(share)), *NONE
            if place < POSITIONS:
                number, doubt = _number(jaw, place, float(share[place]), primary)
            result[k] = replace(crowns[k], number=number, doubt=doubt)
    return tuple(result)


def _numbers(overlaps: Overlaps, dentitions: Sequence[Dentition | None]) -> tuple[Numbers, Primary]:
    crowns = []
    for sighting in overlaps.sightings:
        dentition = dentitions[sighting.view]
        assert dentition is not None
        crowns.append(dentition.all_crowns[sighting.index])
    looks = [softmax(crown_evidence(crown, crown.jaw)) for crown in crowns]
    groups = same_teeth(overlaps, [JAWS.index(crown.jaw) for crown in crowns], looks)
    whole = _wholes(overlaps, groups, looking_alike(looks))
    rows = []
    for jaw in JAWS:
        found = [
            _tooth(group, jaw, crowns, overlaps)
            for k, group in enumerate(groups)
            if crowns[group[0]].jaw == jaw and whole[k] == k and len(group) > 1
        ]
        rows.append([found[k] for k in _order(found, overlaps)])
    places = _places(rows)
    named = [
        (tooth, int(np.argmax(share)), float(share.max()))
        for row, shares in zip(rows, places, strict=True)
        for tooth, share in zip(row, shares, strict=True)
        if np.argmax(share) < POSITIONS
    ]
    said = said_numbers(dentition for dentition in dentitions if dentition)
    primary = _primary(named, _standing(rows, places), said)
    result: Numbers = {}
    for tooth, place, sure in named:
        for member in tooth.members:
            result[overlaps.place(member)] = _number(tooth.jaw, place, sure, primary)
    for group in groups:
        if wisdom := _said_wisdom(group, crowns):
            result |= {overlaps.place(k): (wisdom, LEAST_DOUBT) for k in group}
    for k, group in enumerate(groups):
        if whole[k] != k:
            first = groups[whole[k]][0]
            same = crowns[first].jaw == crowns[group[0]].jaw
            for member in group:
                number = result.get(overlaps.place(first), NONE) if same else NONE
                result[overlaps.place(member)] = number
    return result, primary


def _said_wisdom(group: Sequence[int], crowns: Sequence[Crown]) -> int:
    """The wisdom tooth that a person has said this is, 0: none. Rows have no place for it."""
    said = (crowns[k].number for k in group if number_is_said(crowns[k]))
    return next((number for number in said if number % 10 == WISDOM), 0)


def _places(rows: list[list[_Tooth]]) -> list[Array]:
    """[n, 15] of each row, its teeth's probabilities of the positions and of being no tooth.

    First by looks and order; neighbours by these tell how large the mouth is, and the spaces
    between teeth then count as well.
    """
    evidence = [np.array([tooth.evidence for tooth in row]).reshape(-1, POSITIONS) for row in rows]
    weights = [np.array([tooth.weight for tooth in row]) for row in rows]
    given = list(zip(evidence, weights, strict=True))
    first = [row_probabilities(looks, weight) for looks, weight in given]
    standing = _standing(rows, first)
    unit = unit_of(standing)
    if unit is None:
        return first
    return [
        row_probabilities(looks, weight, spacing_evidence(jaw, centres, unit))
        for (jaw, centres, _), (looks, weight) in zip(standing, given, strict=True)
    ]


def _standing(rows: list[list[_Tooth]], shares: list[Array]) -> list[Row]:
    """The rows with where their teeth stand and the likeliest position of each."""
    return [
        (jaw, np.array([tooth.centre for tooth in row]).reshape(-1, 3), share.argmax(1))
        for jaw, row, share in zip(JAWS, rows, shares, strict=True)
    ]


def _wholes(overlaps: Overlaps, groups: list[list[int]], alike: Array) -> list[int]:
    """Of each group itself, or the larger one of whose tooth it shows a part."""
    of = {member: k for k, group in enumerate(groups) for member in group}
    whole = list(range(len(groups)))
    for k, group in enumerate(groups):
        into: dict[int, float] = {}
        for (i, j), share in overlaps.onto.items():
            if of[i] == k and overlaps.shown[i, overlaps.sightings[j].view] > 0:
                weight = overlaps.shown[i, overlaps.sightings[j].view]
                into[of[j]] = into.get(of[j], 0.0) + share * weight
        others = {o: w for o, w in into.items() if o < k}  # larger ones
        shown = sum(into.values())
        if shown >= LEAST_SHOWN and others:
            best = max(others, key=lambda o: others[o])
            looks = float(alike[np.ix_(group, groups[best])].mean())
            if others[best] > (PART - looks) * shown and into.get(k, 0.0) < others[best]:
                whole[k] = whole[best]
    return whole


def _tooth(members: list[int], jaw: Jaw, crowns: list[Crown], overlaps: Overlaps) -> _Tooth:
    heard = [crowns[k] for k in members if number_is_said(crowns[k])] or [
        crowns[k] for k in members
    ]
    looks = np.array([crown_evidence(crown, jaw) for crown in heard])
    weight = len(members) ** JOINT_POWER
    odds = [value for value in map(primary_odds, heard) if value is not None]
    centre = np.median([overlaps.sightings[k].centre for k in members], axis=0)
    return _Tooth(
        members, jaw, centre, weight, looks.mean(0) * weight,
        float(np.mean(odds)) if odds else None,
    )  # fmt: skip


def _order(teeth: list[_Tooth], overlaps: Overlaps) -> list[int]:
    """The teeth of a row from the patient's right to the left, as all photographs have them.

    Neighbours in a photograph are as far apart along the row as their centres are in the world;
    places along the row are the least squares of that.
    """
    if not teeth:
        return []
    of = {member: k for k, tooth in enumerate(teeth) for member in tooth.members}
    rows: dict[int, list[tuple[int, int]]] = {}
    for member, k in of.items():
        sighting = overlaps.sightings[member]
        rows.setdefault(sighting.view, []).append((sighting.index, k))
    equations, wanted = [], []
    for row in rows.values():
        numbers = [k for _, k in sorted(row)]
        for a, b in pairwise(numbers):
            if a != b:
                equation = np.zeros(len(teeth))
                equation[[a, b]] = -1, 1
                equations.append(equation)
                wanted.append(float(np.linalg.norm(teeth[b].centre - teeth[a].centre)))
    usual = float(np.median(wanted)) if wanted else 1.0
    for k, tooth in enumerate(teeth):
        equation = np.zeros(len(teeth))
        equation[k] = LOOKS_IN_ORDER
        equations.append(equation)
        place = float(softmax(tooth.evidence) @ np.arange(POSITIONS))
        wanted.append(LOOKS_IN_ORDER * usual * place)
    along = np.linalg.lstsq(np.array(equations), np.array(wanted), rcond=None)[0]
    return [int(k) for k in np.argsort(along, kind="stable")]


def _primary(
    named: Sequence[tuple[_Tooth, int, float]], rows: Sequence[Row], said: Mapping[int, bool]
) -> Primary:
    """What named teeth say together of where primary ones stand: by their looks, their distances
    and the permanent molars beside them, for a grown-up's teeth may look like a child's.

    Args:
        named: teeth with their positions, and how sure these are.
        rows: of all of them.
        said: of `said_numbers`.
    """
    looks: dict[int, list[float]] = {}
    molars = {6: 0.0, 7: 0.0}
    for tooth, position, _ in named:
        number = teeth_of(tooth.jaw)[position]
        if number % 10 in molars:
            molars[number % 10] += tooth.weight
        if tooth.primary is not None and number % 10 <= PRIMARY_PLACES:
            looks.setdefault(number, []).append(tooth.primary)
    mean = {number: float(np.mean(odds)) for number, odds in looks.items()}
    return odds_of_left(
        mean, said,
        lambda primary: spacing_cost(rows, primary) + molars_cost(primary, molars[6], molars[7]),
    )  # fmt: skip


def _number(jaw: Jaw, place: int, sure: float, primary: Primary) -> tuple[int, float]:
    """FDI number and doubt of a place in the row, and how sure that is."""
    number = teeth_of(jaw)[place]
    odds = primary.get(number, -np.inf)
    if odds > 0:
        number = primary_of(number)
    return number, float(np.clip(1 - sure * expit(abs(odds)), LEAST_DOUBT, 1))
