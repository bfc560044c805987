"""What a person put right about the teeth, applied to what was read from the photographs."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace
from itertools import groupby, pairwise

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.corrections import (
    Corrections,
    CrownCorrection,
    PhotoCorrection,
    Place,
    composed,
)
from pipeline.artifacts.dental.fdi import JAWS, WISDOM, Jaw, is_left, is_upper
from pipeline.artifacts.teeth import UNREAD, Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError, nearest
from stages.dentition.crowns import (
    centroid,
    mirrored_crown,
    mirrored_dentition,
    outline_of,
    with_outlines,
)
from stages.dentition.parts import joined_parts, perhaps_one
from stages.dentition.tooth_rows import number_is_said

Array = npt.NDArray[np.float64]

SIDES = {"right": "left", "left": "right"}
#: Why a photograph that the user leaves out is set aside.
LEFT_OUT = "left out by hand"
#: A line that leaves less than this share of a crown on one side doesn't part it.
LEAST_PART = 0.03


def apply_corrections(teeth: Teeth, views: Views, corrections: Corrections) -> Teeth:
    """The teeth with what a person said put in place.

    A number that a person gave has doubt 0. The two parts of a crown that was split have none until
    they are given one. Landmarks are computed again where crowns went, came or changed jaw. What
    was set aside because a photograph shows the same that is now left out by hand takes its place.

    Args:
        teeth: as read from the photographs.
        views: the photographs that they were read from.
        corrections: what to change.

    Returns:
        The teeth without pictures, for those would show what was; unchanged where there is nothing
        to correct. Those of mirror images are of the pictures turned over.

    Raises:
        RequestError: a photograph or a crown that isn't there, another picture than what was said
            is of, or a wisdom tooth between others; the message names it.
    """
    if not corrections:
        return teeth
    wanted = photographs_of(views, corrections)
    by_name = views.by_name()
    corrected = []
    for dentition in teeth.views:
        if dentition.name in wanted:
            label, photo = wanted[dentition.name]
            where = f"{corrections.file}, photograph '{label}'"
            dentition = _corrected(dentition, by_name[dentition.name], photo, where)
        corrected.append(dentition)
    names = {view.name: view.source_name or view.name for view in views.views}
    for out in [seen for seen in corrected if seen.set_aside == LEFT_OUT]:
        reason = shows_less(names[out.name])
        second = next((k for k, seen in enumerate(corrected) if seen.set_aside == reason), None)
        if second is not None:
            corrected[second] = replace(corrected[second], set_aside="")
    return Teeth(tuple(corrected))


def shows_less(name: str) -> str:
    """Why a photograph is set aside beside another one, which the user knows by this name."""
    return f"it shows the same as {name}, which is clearer"


def photographs_of(
    views: Views, corrections: Corrections
) -> dict[str, tuple[str, PhotoCorrection]]:
    """View name -> (what the user calls it, its corrections).

    Raises:
        RequestError: a photograph that isn't there, is named twice, or is another picture.
    """
    names = {view.name: view.name for view in views.views}
    # A stem that two photographs share names neither.
    stems = [view.source_name.rpartition(".")[0] for view in views.views]
    names |= {
        stem: view.name for stem, view in zip(stems, views.views, strict=True)
        if stem and stems.count(stem) == 1
    }  # fmt: skip
    names |= {view.source_name: view.name for view in views.views if view.source_name}
    names = {composed(name): view for name, view in names.items()}
    found: dict[str, tuple[str, PhotoCorrection]] = {}
    for label, photo in corrections.photographs.items():
        name = names.get(composed(label))
        if name is None:
            sources = [view.source_name or view.name for view in views.views]
            raise RequestError(
                f"{corrections.file}: there is no photograph '{label}'.{nearest(label, names)} The "
                f"photographs are {', '.join(sources)}."
            )
        if name in found:
            raise RequestError(
                f"{corrections.file}: '{found[name][0]}' and '{label}' are the same "
                "photograph; say it once."
            )
        if not photo.is_of(views.by_name()[name].source_sha256):
            raise RequestError(
                f"{corrections.file}, photograph '{label}': what it says is of another picture, "
                "which had this name. Take it out of the file and run again: check.html then shows "
                "the picture that is there now. If it is the same one, saved anew, take out its "
                "line sha256 alone."
            )
        found[name] = label, photo
    return found


def _corrected(dentition: Dentition, view: View, photo: PhotoCorrection, where: str) -> Dentition:
    if dentition.kind == UNREAD and (photo.use or photo.crowns):
        raise RequestError(
            f"{where}: its teeth have not been read, for of many photographs only some are. "
            "--set teeth.method=reader reads every one."
        )
    mirrored = dentition.mirrored if photo.mirrored is None else photo.mirrored
    dentition, view = _as_taken(dentition, view)
    crowns, gone = list(dentition.all_crowns), list[Crown]()
    moved = False
    for k, change in enumerate(photo.crowns):
        moved |= _change(crowns, gone, change, view, f"{where}, crowns[{k}]")
    kind = photo.kind or dentition.kind
    set_aside = dentition.set_aside
    if photo.use is not None:
        set_aside = "" if photo.use else LEFT_OUT
    if photo.use and not crowns:
        raise RequestError(
            f"{where}: use is true, but no tooth was found in this photograph. Leave it out."
        )
    corrected = replace(dentition, kind=kind, set_aside=set_aside)
    if moved:
        corrected = with_outlines(corrected, [outline_of(crown) for crown in crowns])
    else:
        corrected = replace(
            corrected,
            upper=tuple(crown for crown in crowns if crown.jaw == "upper"),
            lower=tuple(crown for crown in crowns if crown.jaw == "lower"),
        )
    # Rows have no place for wisdom teeth: nothing later would find that two parts are one.
    corrected = joined_parts(
        corrected,
        [[_said_wisdom(crown) for crown in corrected.crowns(jaw)] for jaw in JAWS],
    )  # fmt: skip
    for jaw in JAWS:
        _check_wisdom_teeth(corrected.crowns(jaw), where)
        _check_order(corrected.crowns(jaw)[:: -1 if mirrored else 1], where)
    if not mirrored:
        return replace(corrected, mirrored=mirrored)
    turned = mirrored_dentition(corrected)
    return replace(turned, kind=photo.kind or turned.kind)


def _said_wisdom(crown: Crown) -> int:
    """The wisdom tooth that a person has said this is, 0: none."""
    return crown.number if number_is_said(crown) and crown.number % 10 == WISDOM else 0


def _check_wisdom_teeth(row: tuple[Crown, ...], where: str) -> None:
    """Refuse a wisdom tooth between others: the row has no place for it, and would go on around."""
    numbered = [crown for crown in row if crown.number]
    for crown in numbered[1:-1]:
        if _said_wisdom(crown):
            raise RequestError(
                f"{where}: {crown.number} is a wisdom tooth and stands at an end of its row, but "
                "there are crowns on both sides of this one. Give it another number, or remove "
                "what is no tooth beyond it."
            )


def _check_order(row: tuple[Crown, ...], where: str) -> None:
    """Refuse what can't be said of a row, as photographs have it: one tooth at two places, and a
    row that runs backwards."""
    said = [crown.number if number_is_said(crown) else 0 for crown in row]
    runs = [number for number, _ in groupby(said) if number]
    if twice := next((number for number in runs if runs.count(number) > 1), 0):
        raise RequestError(
            f"{where}: {twice} is said of crowns that are not side by side. Only neighbours can be "
            "parts of one tooth: give one of them another number, or remove what lies between them."
        )
    stands = [number % 10 if is_left(number) else -(number % 10) for number in runs]
    if len(stands) > 2 and all(after < before for before, after in pairwise(stands)):
        raise RequestError(
            f"{where}: the numbers said run backwards ({', '.join(map(str, runs))} from left to "
            "right). Say whether it is a mirror image (mirrored: true) or none (mirrored: false); "
            "if that is right, left and right are mixed up in the numbers."
        )


def _as_taken(dentition: Dentition, view: View) -> tuple[Dentition, View]:
    """Both as the photograph was taken: places are pixels of that."""
    return (
        mirrored_dentition(dentition) if dentition.mirrored else dentition,
        view.mirrored() if view.turned_over else view,
    )


def crowns_before(
    dentition: Dentition, view: View, photo: PhotoCorrection, mirrored: bool
) -> list[list[Crown]]:
    """What was there before each change that a person asked for.

    Args:
        dentition: as it was read from the photograph.
        view: the photograph.
        photo: what was said of it.
        mirrored: the crowns are to be those of the picture turned over.

    Returns:
        For each change the crown that it is about, and of a split that parts what was read as two
        the other one as well; empty: none is read there.
    """
    dentition, view = _as_taken(dentition, view)
    crowns, gone, found = list(dentition.all_crowns), list[Crown](), list[list[Crown]]()
    for change in photo.crowns:
        before = list(crowns)
        with suppress(RequestError):  # the next run says so
            _change(crowns, gone, change, view, "")
        changed = [crown for crown in before if not any(crown is now for now in crowns)]
        width = dentition.size[0]
        found.append([mirrored_crown(crown, width) if mirrored else crown for crown in changed])
    return found


def _change(
    crowns: list[Crown], gone: list[Crown], change: CrownCorrection, view: View, where: str
) -> bool:
    """Change one crown in place; says whether landmarks have to be found again.

    Args:
        gone: crowns that were removed before; one more is added here.
    """
    index = _crown_at(crowns, gone, view.working_place(change.at), change.at, where)
    crown = crowns[index]
    if change.tooth is not None:
        jaw: Jaw = "upper" if is_upper(change.tooth) else "lower"
        crowns[index] = replace(crown, number=change.tooth, doubt=0.0, jaw=jaw)
        return jaw != crown.jaw
    if change.split is None:
        gone.append(crowns.pop(index))
        return True
    start, end = (view.working_place(place) for place in change.split)
    parts = split_polygon(crown.outline, start, end)
    areas = [area(part) for part in parts]
    unknown = replace(crown, number=0, doubt=1.0, numbers={})
    if min(areas) >= LEAST_PART * max(sum(areas), 1e-9):
        crowns[index : index + 1] = [replace(unknown, outline=part) for part in parts]
        return True
    # What was shown as one crown may have been read as two: now it is said that they are.
    other = _across(crowns, index, start, end)
    if other is None:
        raise RequestError(
            f"{where}.split: the line doesn't cross the crown at {_said(change.at)}."
        )
    crowns[index] = unknown
    crowns[other] = replace(crowns[other], number=0, doubt=1.0, numbers={})
    return True


def _across(crowns: list[Crown], index: int, start: Array, end: Array) -> int | None:
    """The crown on the other side of a line that may be part of one with that of this index."""
    across = np.array([start[1] - end[1], end[0] - start[0]])
    side = [np.sign((centroid(c.outline) - start) @ across) for c in crowns]
    mine = crowns[index]
    for k, crown in enumerate(crowns):
        if crown.jaw == mine.jaw and side[k] * side[index] < 0 and perhaps_one(mine, crown):
            return k
    return None


def _crown_at(crowns: list[Crown], gone: list[Crown], place: Array, said: Place, where: str) -> int:
    """The crown under a place, or the nearest one within half its width, if none that has gone is
    meant."""
    point = (float(place[0]), float(place[1]))
    inside = [
        cv2.pointPolygonTest(crown.outline.astype(np.float32)[:, None], point, True)
        if len(crown.outline) >= 3 else -np.inf
        for crown in [*crowns, *gone]
    ]  # fmt: skip
    best = max(inside[: len(crowns)], default=-np.inf)
    if best < 0 and max(inside[len(crowns) :], default=-np.inf) >= 0:
        raise RequestError(
            f"{where}: the crown at {_said(said)} was removed by a line before this one. Take one "
            "of the two out."
        )
    near = [k for k, crown in enumerate(crowns) if -inside[k] <= crown.width / 2]
    if not near:
        raise RequestError(
            f"{where}: there is no crown at {_said(said)}. Open check.html to see where they are."
        )
    return max(near, key=lambda index: inside[index])


def _said(place: Place) -> str:
    return f"{place[0]:g}, {place[1]:g}"


def split_polygon(polygon: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """The parts of a polygon [K, 2] on either side of the line through two points.

    Sutherland and Hodgman, Reentrant Polygon Clipping (1974), for each of the two half planes. Of a
    polygon that the line crosses more than twice, the pieces of a side hang together along it.
    """
    across = np.array([start[1] - end[1], end[0] - start[0]])
    height = (polygon - start) @ across
    return _clipped(polygon, height), _clipped(polygon, -height)


def _clipped(polygon: Array, height: Array) -> Array:
    """The part of a polygon where a linear function, given at its corners, is not negative."""
    kept = []
    for k in range(len(polygon)):
        before, now = height[k - 1], height[k]
        if (before < 0) != (now < 0):
            share = before / (before - now)
            kept.append(polygon[k - 1] + share * (polygon[k] - polygon[k - 1]))
        if now >= 0:
            kept.append(polygon[k])
    return np.array(kept).reshape(-1, 2)


def area(polygon: Array) -> float:
    """Square pixels inside a polygon [K, 2]."""
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def says_side(name: str) -> str:
    """`right` or `left` where a file's name says one of them, "" otherwise.

    A word or part of one in camel case: Wright and cleft say nothing.
    """
    begins = "(?<![A-Za-z])|(?<=[a-z])(?=[A-Z])"
    said = [side for side in SIDES if re.search(f"(?:{begins})(?i:{side})", name)]
    return said[0] if len(said) == 1 else ""
