"""What an orthodontist measures first, from landmarks in 3D: values, doubts, and what is missing.

Lengths are along the mouth's own axes: x to the patient's left, y up, z out of the mouth, from the
row of crowns, not from how the camera was held. A length's uncertainty holds in 19 of 20 cases: the
landmarks' errors (drawn at random, `DRAWS` times) and that of the scale together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.artifacts.dental.fdi import is_left, is_upper, other_side
from pipeline.artifacts.space.scale import Scale
from stages.export.measuring.covered_bite import (
    BECAUSE,
    METHOD,
    SPREAD,
    CoveredBite,
    covered_bite,
)
from stages.export.measuring.landmarks import Landmark, Name, Reading
from stages.export.measuring.places import (
    Array,
    Places,
    centres_of,
    mean_place,
    places_of,
    spacing_of,
    with_primary,
)

DRAWS = 100
#: From a standard deviation to what holds in 19 of 20 cases.
_WIDE = 1.96
#: Sure and fair: the uncertainty is under this share of the distance between neighbouring crowns.
_SURE, _FAIR = 0.08, 0.25
#: Less than this, which pages show as 0.0 mm, is nothing, and has no direction; without a scale
#: this share of the same distance is.
_NOTHING_MM, _NOTHING = 0.05, 0.006
#: Above this doubt of a number the value is of no use.
MOST_DOUBT = 0.5
#: A row of crowns this much flatter than long has no plane of its own.
_FLAT = 0.12

NOTES = {
    "value": "in the units of scale; null: see not_visible",
    "uncertainty": "holds in 19 of 20 cases, that of the scale (its counted_percent) included",
    "sure": "sure, fair or unsure: the uncertainty beside the size of a tooth, and the doubt",
    "doubt": "0..1, that a tooth it is measured at has another number",
    "estimated": "null: it is measured; else why it can't be, and the share of the covered crowns "
    "that lies behind the other teeth, in percent, with an uncertainty as above",
}


@dataclass(frozen=True)
class Rule:
    """How one value is measured.

    Attributes:
        name, title: for programs and for people.
        method: how, in a sentence.
        needs: the landmark's name, and groups of teeth; one of each group must be there.
        measure: places and the mouth's axes [3, 3] (rows left, up, out) -> the value and the two
            points [2, 3] that it is drawn between.
        stands_for: how well what is seen stands for what is meant, a standard deviation as share
            of the size of a tooth: from generated mouths, whose crowns are known, in whole runs.
        signs: what a positive and a negative value are called, where there is a sign.
        covered: times less sure where the other jaw covers the edge of one of its teeth, at which
            it is measured then, or which it leaves out: an overbite at the others is too small.
        estimate: what to estimate it at where it can't be measured, or why not; see `covered_bite`.
    """

    name: str
    title: str
    method: str
    needs: Sequence[tuple[Name, tuple[int, ...]]]
    measure: Callable[[Places, Array], tuple[float, Array]]
    stands_for: float
    signs: tuple[str, str] = ("", "")
    covered: float = 1.0
    estimate: Callable[[Reading, float], CoveredBite | str] = lambda reading, most_doubt: ""


def measure_mouth(reading: Reading, up: Array, scale: Scale, seed: int = 0) -> list[dict[str, Any]]:
    """All measurements of a mouth, those that can't be made with the reason.

    Args:
        reading: the landmarks.
        up: [3] up in the photographs, for rows that have no plane of their own.
        scale: of the lengths.
        seed: of the random draws.

    Returns:
        One entry a measurement: name, title, method, value, uncertainty, unit, sure, doubt, teeth,
        points [2][3], direction, estimated (None: it is measured) and not_visible (an empty
        sentence where there is a value).
    """
    places = reading.places
    axes = mouth_axes(places, up)
    spacing = spacing_of(places)
    random = np.random.default_rng(seed)
    draws = [
        (draw, turned)
        for draw in _drawn(reading.landmarks, random)
        if (turned := mouth_axes(draw, up)) is not None
    ]
    found = []
    for rule in RULES:
        teeth, missing = _teeth_of(rule, reading, axes)
        bite = rule.estimate(reading, MOST_DOUBT) if missing and axes is not None else ""
        entry: dict[str, Any] = {
            "name": rule.name, "title": rule.title, "method": rule.method, "value": None,
            "uncertainty": None, "unit": scale.unit, "sure": None, "doubt": None,
            "direction": "", "teeth": sorted(teeth), "points": None, "estimated": None,
            "not_visible": missing,
        }  # fmt: skip
        if axes is not None and isinstance(bite, CoveredBite):
            entry |= _estimated(rule, bite, places, axes, draws, scale)
            entry |= _surety(entry["uncertainty"], _doubt(reading, set(bite.teeth)), spacing)
            if entry["sure"] == "sure":
                entry["sure"] = "fair"
        elif axes is not None and not missing:
            covered = any(_covered(group, reading) for _, group in rule.needs)
            entry |= _measured(rule, teeth, covered, places, axes, draws, scale)
            entry |= _surety(entry["uncertainty"], _doubt(reading, teeth), spacing)
        elif bite:
            entry["not_visible"] += f"; {bite}"
        found.append(entry)
    return found


def _measured(
    rule: Rule, teeth: set[int], covered: bool, places: Places, axes: Array,
    draws: Sequence[tuple[Places, Array]], scale: Scale,
) -> dict[str, Any]:  # fmt: skip
    """A value that is measured, and how far it may be off."""
    value, points = rule.measure(places_of(places, teeth), axes)
    values = [rule.measure(places_of(draw, teeth), turned)[0] for draw, turned in draws]
    share = rule.stands_for * (rule.covered if covered else 1.0)
    spacing = spacing_of(places)
    nothing = _NOTHING_MM if scale.unit == "mm" else _NOTHING * spacing
    off = [float(np.std(values)), share * spacing, value * scale.counted_percent / 100]
    return {
        "value": _rounded(value),
        "uncertainty": _rounded(_WIDE * float(np.linalg.norm(off))),
        "direction": rule.signs[0 if value >= 0 else 1] if abs(value) >= nothing else "",
        "points": [[_rounded(x) for x in point] for point in points],
    }


def _estimated(
    rule: Rule, bite: CoveredBite, places: Places, axes: Array,
    draws: Sequence[tuple[Places, Array]], scale: Scale,
) -> dict[str, Any]:  # fmt: skip
    """The same of one that is estimated: an edge that is covered is not below what covers it."""
    height, seen = bite.heights(places, axes)
    value = min(max(height - seen, 0.0), height)
    heights, seens = np.array([bite.heights(draw, turned) for draw, turned in draws]).T
    stands_for = rule.stands_for * spacing_of(places)
    off = [
        np.std(heights - seens),
        stands_for,
        SPREAD * height,
        value * scale.counted_percent / 100,
    ]
    share_off = [np.std(seens / heights), stands_for / height, SPREAD * seen / height]
    return {
        "method": METHOD,
        "value": _rounded(value),
        "uncertainty": _rounded(_WIDE * float(np.linalg.norm(off))),
        "direction": rule.signs[0],
        "teeth": sorted(bite.teeth),
        "points": [[_rounded(x) for x in p] for p in bite.points(places, axes, value)],
        "estimated": {
            "because": BECAUSE,
            "covered_percent": round(100 * value / height, 1),
            "covered_percent_uncertainty": round(100 * _WIDE * float(np.linalg.norm(share_off)), 1),
        },
        "not_visible": "",
    }


def mouth_axes(places: Places, up: Array) -> Array | None:
    """[3, 3] rows: the patient's left, up, out of the mouth; None with too few crowns.

    Up is at right angles to the rows of crowns (both at once, each about its own middle); where
    only front teeth are seen it is the photographs', at right angles to the row.
    """
    centres = centres_of(places)
    jaws = [
        np.array([p for n, p in centres.items() if is_upper(n) == jaw]) for jaw in (True, False)
    ]
    rows = [row - row.mean(0) for row in jaws if len(row) >= 2]
    left = _leftward(centres)
    if not rows or left is None or len(centres) < 4:
        return None
    _, sizes, directions = np.linalg.svd(np.concatenate(rows), full_matrices=False)
    normal = directions[2]
    if sizes[1] < _FLAT * sizes[0]:
        normal = up
    both = len(jaws[0]) > 0 and len(jaws[1]) > 0
    towards = jaws[0].mean(0) - jaws[1].mean(0) if both else up
    normal = normal * (1.0 if normal @ towards >= 0 else -1.0)
    x = left - (left @ normal) * normal / (normal @ normal)
    if np.linalg.norm(x) < 1e-9:
        return None
    x /= np.linalg.norm(x)
    y = normal - (normal @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def _leftward(centres: Mapping[int, Array]) -> Array | None:
    """Sum of the differences between teeth of both sides, or between the sides' middles."""
    pairs = [
        point - centres[other_side(number)]
        for number, point in centres.items()
        if is_left(number) and other_side(number) in centres
    ]
    if pairs:
        return np.asarray(np.sum(pairs, axis=0))
    sides = [[p for n, p in centres.items() if is_left(n) == side] for side in (True, False)]
    if not sides[0] or not sides[1]:
        return None
    return np.asarray(np.mean(sides[0], axis=0) - np.mean(sides[1], axis=0))


def _drawn(
    landmarks: Mapping[tuple[Name, int], Landmark], random: np.random.Generator
) -> list[dict[tuple[Name, int], Array]]:
    """`DRAWS` times all places with errors as their covariances say."""
    keys = sorted(landmarks)
    if not keys:
        return [{}] * DRAWS
    roots = [np.linalg.cholesky(landmarks[key].covariance + 1e-18 * np.eye(3)) for key in keys]
    noise = random.standard_normal((DRAWS, len(keys), 3))
    return [
        {
            key: landmarks[key].point + root @ n
            for key, root, n in zip(keys, roots, row, strict=True)
        }
        for row in noise
    ]


def _teeth_of(rule: Rule, reading: Reading, axes: Array | None) -> tuple[set[int], str]:
    """The teeth that a rule measures at, and why it can't ("" where it can)."""
    teeth: set[int] = set()
    for name, group in rule.needs:
        there = [
            n for n in with_primary(group)
            if (mark := reading.get(name, n)) is not None and mark.doubt <= MOST_DOUBT
        ]  # fmt: skip
        if not there:
            return set(), _why(name, group, rule, reading)
        teeth |= set(there)
    if axes is None:
        return teeth, "too few crowns on both sides are seen to know how the mouth stands"
    return teeth, ""


def _why(name: Name, group: Sequence[int], rule: Rule, reading: Reading) -> str:
    """Why a landmark can't be had from any of a group of teeth."""
    named = " or ".join(map(str, group))
    seen = [n for n in with_primary(group) if reading.get("edge", n) is not None]
    if name == "tip" and all(_covered(group, reading) for _, group in rule.needs):
        return (
            "the edges of the upper and lower teeth meet in every photograph, and either may "
            "cover the other"
        )
    if name == "tip" and _covered(group, reading):
        jaw, other = ("upper", "lower") if is_upper(group[0]) else ("lower", "upper")
        return (
            f"the {other} teeth cover the edges of the {jaw} ones in every photograph; one taken "
            f"from {'below' if jaw == 'lower' else 'above'} may show them"
        )
    if any((mark := reading.get("edge", n)) and mark.doubt > MOST_DOUBT for n in seen):
        return f"it is not sure which tooth is {named}"
    if name == "mesial" and seen:
        gone = [n for n in group if not {n, n + 40} & set(seen)]
        if not gone:
            return f"no photograph from the front shows where {group[0]} and {group[1]} meet"
        named = str(gone[0])
    return f"no photograph shows {named} with depth"


def _covered(group: Sequence[int], reading: Reading) -> bool:
    return any(n in reading.covered for n in with_primary(group))


def _doubt(reading: Reading, teeth: set[int]) -> float:
    right = 1.0
    for number in teeth:
        doubts = [m.doubt for (_, n), m in reading.landmarks.items() if n == number]
        right *= 1 - min(doubts)
    return 1 - right


def _surety(off: float, doubt: float, spacing: float) -> dict[str, Any]:
    sure = "fair" if off <= _FAIR * spacing and doubt < 0.2 else "unsure"
    if off <= _SURE * spacing and doubt < 0.05:
        sure = "sure"
    return {"doubt": round(doubt, 4), "sure": sure}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _overjet(places: Places, axes: Array) -> tuple[float, Array]:
    above, below = mean_place(places, "rim", (11, 21)), mean_place(places, "edge", (31, 41))
    out = float(axes[2] @ (above - below))
    return out, np.array([above, above - out * axes[2]])


def _overbite(places: Places, axes: Array) -> tuple[float, Array]:
    above, below = mean_place(places, "tip", (11, 21)), mean_place(places, "tip", (31, 41))
    over = float(axes[1] @ (below - above))
    return over, np.array([above, above + over * axes[1]])


def _midline(places: Places, axes: Array) -> tuple[float, Array]:
    above, below = mean_place(places, "mesial", (11, 21)), mean_place(places, "mesial", (31, 41))
    shift = float(axes[0] @ (below - above))
    return shift, np.array([above, above + shift * axes[0]])


def _width(name: Name, right: int, left: int) -> Callable[[Places, Array], tuple[float, Array]]:
    def measure(places: Places, axes: Array) -> tuple[float, Array]:
        ends = np.array([mean_place(places, name, (right,)), mean_place(places, name, (left,))])
        return float(np.linalg.norm(ends[1] - ends[0])), ends

    return measure


def _canines(jaw: str, right: int, left: int) -> Rule:
    return Rule(
        f"intercanine_{jaw}", f"Intercanine width, {jaw}", "between the tips of the canines",
        (("edge", (right,)), ("edge", (left,))), _width("edge", right, left), 0.05, covered=2.5,
    )  # fmt: skip


def _molars(jaw: str, right: int, left: int) -> Rule:
    return Rule(
        f"intermolar_{jaw}", f"Intermolar width, {jaw}",
        "between the middles of the outer faces of the first molars, as far as seen",
        (("centre", (right,)), ("centre", (left,))), _width("centre", right, left), 0.22,
    )  # fmt: skip


RULES = (
    Rule(
        "overjet", "Overjet",
        "from the edges of the upper central incisors straight back to the faces of the lower ones",
        (("rim", (11, 21)), ("edge", (31, 41))), _overjet, 0.08, ("", "reversed"),
    ),
    Rule(
        "overbite", "Overbite",
        "how far the upper central incisors reach over the edges of the lower ones",
        (("tip", (11, 21)), ("tip", (31, 41))), _overbite, 0.08, ("", "open"), covered=1.5,
        estimate=covered_bite,
    ),
    Rule(
        "midline_shift", "Midline shift",
        "from the upper to the lower midline, where the central incisors meet",
        (("mesial", (11, 21)), ("mesial", (31, 41))), _midline, 0.03,
        ("lower midline to the patient's left", "lower midline to the patient's right"),
    ),
    *(_canines(jaw, right, left) for jaw, right, left in (("upper", 13, 23), ("lower", 43, 33))),
    *(_molars(jaw, right, left) for jaw, right, left in (("upper", 16, 26), ("lower", 46, 36))),
)  # fmt: skip
