"""What the pipeline made of an item against the truth; thresholds from many; for `triads.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
from triads_data import CASE, FRONTS, SERIES, SIDES, SWAPPED, Item, Photo, TruthPoint
from triads_run import Outcome

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import JAWS, permanent_of
from pipeline.artifacts.teeth import Crown, Dentition
from stages.dentition.overlay import DOUBT_SHOWN
from stages.dentition.working import working_scale
from stages.init.sfm.matching.epipolar import fundamental_between, sampson_distance

if TYPE_CHECKING:
    from stages.init.dental.solution import PlacedView

Array = npt.NDArray[np.float64]
Row = dict[str, Any]
#: Two photographs need so many landmarks in common for an epipolar error.
LEAST_LANDMARKS = 4


def score_item(item: Item, outcome: Outcome) -> Row:
    """The figures of one item, ready for JSON.

    `right`: no truth point carries a wrong number that is not marked as doubtful, all photographs
    are of one patient and closed, and at least one truth point is found; what a scene of it must be
    to be shown.
    """
    photos = _photos_by_view(item, outcome)
    numbered = outcome.teeth.by_name() if outcome.teeth else {}
    used = outcome.placed if outcome.accepted else tuple(v.name for v in _chosen(outcome))
    counts: Row = {"whole": _zeros(), "partial": _zeros()}
    wrong: list[Row] = []
    for name, photo in photos.items():
        dentition = numbered.get(name)
        if dentition is None or (outcome.accepted and name not in used):
            dentition = Dentition(name, (1, 1), "none")  # its teeth are not in the scene
        found = max(
            (score_points(dentition, photo.truth, flip) for flip in {False, photo.mirrored}),
            key=lambda one: sum(count["right"] for count in one[0].values()),
        )
        for part, figures in found[0].items():
            counts[part] = {key: counts[part][key] + figures[key] for key in figures}
        wrong += [{"photo": photo.shown, **entry} for entry in found[1] if name in used]
    patients = {photos[name].patient for name in used}
    together = len(patients) == 1 and all(photos[name].closed for name in used)
    whole = counts["whole"]
    row: Row = {
        "name": item.name,
        "sort": item.sort,
        "patients": sorted(item.patients),
        "accepted": outcome.accepted,
        "why_not": "" if outcome.accepted else outcome.message,
        "right": bool(together and whole["found"] and not any(unmarked(one) for one in wrong)),
        "one_closed_mouth": together,
        **counts,
        "wrong": wrong,
        "confidence": confidence(outcome),
        "seconds": {name: round(value, 2) for name, value in outcome.seconds.items()},
        "warnings": list(outcome.warnings),
        "figures": all_figures(outcome),
        "doubts": list(outcome.fit.doubts) if outcome.fit else [],
        "set_aside": {
            photos[view.name].shown: view.set_aside
            for view in (outcome.read.views if outcome.read else ())
            if view.set_aside or not view.all_crowns
        },
        "used": sorted(photos[name].shown for name in used),
    }
    if item.sort in (CASE, SWAPPED):
        row["epipolar"] = epipolar_error(outcome)
    if item.sort == SERIES:
        stems = set(row["used"])
        row["chosen_right"] = stems >= SIDES and bool(stems & FRONTS) and stems <= SIDES | FRONTS
    return row


def unmarked(entry: Row) -> bool:
    """Does a wrong number stand there as if it were sure?"""
    return entry["doubt"] <= DOUBT_SHOWN


def _photos_by_view(item: Item, outcome: Outcome) -> dict[str, Photo]:
    """View name -> the photograph."""
    by_stem = {photo.shown: photo for photo in item.photos}
    return {view.name: by_stem[view.source_name.rpartition(".")[0]] for view in outcome.views.views}


def _chosen(outcome: Outcome) -> tuple[Dentition, ...]:
    return outcome.read.chosen if outcome.read else ()


def _zeros() -> dict[str, int]:
    names = (
        "points", "found", "right", "right_place", "wrong", "wrong_but_marked", "in_one_crown",
    )  # fmt: skip
    return dict.fromkeys(names, 0)


def score_points(
    dentition: Dentition, truth: Sequence[TruthPoint], mirrored: bool
) -> tuple[dict[str, dict[str, int]], list[Row]]:
    """Count truth points that lie in a crown, and those whose crown has the right number.

    Args:
        dentition: of the photograph.
        truth: its points.
        mirrored: the photograph is that of the truth, mirrored.

    Returns:
        The counts of `whole` and `partial` points, and the whole ones that carry a wrong number.
        `right_place`: the number, be it of the permanent tooth or of the primary one there;
        `in_one_crown`: with the point of another tooth.
    """
    counts = {"whole": _zeros(), "partial": _zeros()}
    wrong = []
    crowded = _in_one_crown(dentition, truth, mirrored)
    for point in truth:
        count = counts["partial" if point.partial else "whole"]
        count["points"] += 1
        around = _crowns_at(dentition, point, mirrored)
        count["in_one_crown"] += point in crowded
        count["found"] += bool(around)
        right = any(crown.number in point.numbers for crown in around)
        count["right"] += right
        places = {permanent_of(number) for number in point.numbers}
        count["right_place"] += any(permanent_of(c.number) in places for c in around if c.number)
        said = [crown for crown in around if crown.number]
        if said and not right:
            surest = min(said, key=lambda crown: crown.doubt)
            count["wrong"] += 1
            count["wrong_but_marked"] += surest.doubt > DOUBT_SHOWN
            if not point.partial:
                wrong.append(
                    {"truth": point.numbers[0], "said": surest.number, "doubt": surest.doubt}
                )
    return counts, wrong


def _crowns_at(dentition: Dentition, point: TruthPoint, mirrored: bool) -> list[Crown]:
    """The crowns with a truth point inside."""
    place = (
        (1 - point.x if mirrored else point.x) * dentition.size[0],
        point.y * dentition.size[1],
    )
    return [
        crown
        for crown in dentition.all_crowns
        if len(crown.outline) >= 3
        and cv2.pointPolygonTest(crown.outline.astype(np.float32)[:, None], place, False) >= 0
    ]


def _in_one_crown(
    dentition: Dentition, truth: Sequence[TruthPoint], mirrored: bool
) -> set[TruthPoint]:
    """Truth points that share the only crown around them with another one."""
    alone: dict[int, list[TruthPoint]] = {}
    for point in truth:
        around = _crowns_at(dentition, point, mirrored)
        if len(around) == 1:
            alone.setdefault(id(around[0]), []).append(point)
    return {point for points in alone.values() if len(points) > 1 for point in points}


def confidence(outcome: Outcome) -> float | None:
    """The one figure of how sure the fit is; None where there is no fit."""
    if outcome.fit is None:
        return None
    found = getattr(outcome.fit, "confidence", None)
    value = float(outcome.fit.margin if found is None else found)
    return value if np.isfinite(value) else None


def all_figures(outcome: Outcome) -> Row:
    """Every figure that a threshold could be set on."""
    figures: Row = {
        f"{stage}.{k}": v for stage, own in outcome.figures.items() for k, v in own.items()
    }
    if outcome.fit is not None:
        figures |= {"margin": outcome.fit.margin, **outcome.fit.figures}
        for number, placed in enumerate(outcome.fit.views):
            if placed is not None:
                figures[f"role_{number}"] = placed.role
    for number, view in enumerate(outcome.read.views if outcome.read else ()):
        crowns = view.all_crowns
        figures |= {
            f"kind_{number}": view.kind,
            f"jaws_apart_{number}": view.jaws_apart,
            f"crowns_{number}": len(crowns),
            f"mean_score_{number}": float(np.mean([c.score for c in crowns])) if crowns else 0.0,
        }
    return {
        key: round(value, 5) if isinstance(value, float) and np.isfinite(value) else str(value)
        if isinstance(value, float) else value
        for key, value in figures.items()
    }  # fmt: skip


def epipolar_error(outcome: Outcome) -> Row | None:
    """Median Sampson distance of tooth landmarks that two photographs have in common.

    Returns:
        In pixels and as a share of the height of the band of teeth, with the count of landmarks;
        None where too few are shared.
    """
    if outcome.fit is None or outcome.teeth is None:
        return None
    by_name = outcome.teeth.by_name()
    # The fit saw the photographs at their working size.
    seen = [
        (read, replace(placed, focal=placed.focal / working_scale(*read.size)))
        for name, placed in zip(outcome.fitted, outcome.fit.views, strict=True)
        if placed is not None and (read := by_name.get(name)) is not None
    ]
    distances, shares = [], []
    for (first, one), (second, two) in combinations(seen, 2):
        a, b = landmarks(first), landmarks(second)
        shared = sorted(set(a) & set(b))
        if len(shared) < LEAST_LANDMARKS:
            continue
        fundamental = fundamental_between(_camera(one, first.size), _camera(two, second.size))
        off = sampson_distance(
            fundamental, np.array([a[k] for k in shared]), np.array([b[k] for k in shared])
        )
        distances += off.tolist()
        shares += (off / (0.5 * (first.band_height + second.band_height))).tolist()
    if not distances:
        return None
    return {
        "px": round(float(np.median(distances)), 3),
        "of_band": round(float(np.median(shares)), 5),
        "landmarks": len(distances),
    }


def landmarks(dentition: Dentition) -> dict[tuple[str, int, int], Array]:
    """Zeniths, and papillae between teeth next to each other, by number."""
    found: dict[tuple[str, int, int], Array] = {}
    for jaw in JAWS:
        crowns = dentition.crowns(jaw)
        for crown in crowns:
            if crown.number and not (crown.cut_left or crown.cut_right or crown.doubtful):
                found["zenith", crown.number, 0] = crown.zenith
        for crown, after in pairwise(crowns):
            if crown.number and after.number and crown.papilla_right is not None:
                found["papilla", crown.number, after.number] = crown.papilla_right
    return found


def _camera(placed: PlacedView, size: tuple[int, int]) -> Camera:
    focal, centre = placed.focal, (size[0] / 2, size[1] / 2)
    return Camera("", *size, focal, focal, *centre, placed.cam_from_world)


def is_good(row: Row) -> bool:
    """Must this item become a scene? Otherwise it must not."""
    return row["sort"] in (CASE, SWAPPED, SERIES) and row["right"]


def is_wrong(row: Row) -> bool:
    """Would it be wrong to show a scene of this item?

    A mix that was put right (the photograph that doesn't belong is left out, or turned back) is
    not; nor is it asked for.
    """
    return not row["right"]


def lowest_threshold(rows: Sequence[Row]) -> float:
    """The lowest confidence that is above that of every wrong item."""
    wrong = [r["confidence"] for r in rows if is_wrong(r) and r["confidence"] is not None]
    return float(np.nextafter(max(wrong), np.inf)) if wrong else -float("inf")


def leave_one_out(rows: Sequence[Row]) -> list[Row]:
    """Each case judged by the threshold that the items of all other patients give."""
    result = []
    for row in rows:
        if row["sort"] != CASE:
            continue
        others = [other for other in rows if row["name"] not in other["patients"]]
        threshold = lowest_threshold(others)
        sure = row["confidence"] is not None and row["confidence"] >= threshold
        passes = bool(sure and row["right"])
        wrong = bool(sure and not row["right"])
        result.append(
            {"name": row["name"], "threshold": threshold if np.isfinite(threshold) else None,
             "confidence": row["confidence"], "passes": passes, "accepted_wrong": wrong}
        )  # fmt: skip
    return result


def curve(rows: Sequence[Row]) -> Row:
    """Over the threshold: share of the good items accepted, and of the wrong ones."""
    sure = [(is_good(r), is_wrong(r), r["confidence"]) for r in rows]
    values = sorted({c for _, _, c in sure if c is not None})
    points = []
    for threshold in values:
        passed = [(good, wrong) for good, wrong, c in sure if c is not None and c >= threshold]
        points.append((threshold, sum(g for g, _ in passed), sum(w for _, w in passed)))
    if values:
        points.append((float(np.nextafter(values[-1], np.inf)), 0, 0))
    return {
        "good": sum(good for good, _, _ in sure),
        "wrong": sum(wrong for _, wrong, _ in sure),
        "points": points,
    }
