"""`teeth.json`: every tooth with its numbers, its place in 3D and its outlines; `teeth.csv`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import is_primary, is_upper, universal_number
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Crown, Dentition, Teeth, filled
from pipeline.artifacts.views import View, Views
from stages.dentition.overlay import DOUBT_SHOWN
from stages.dentition.working import outline_in_view
from stages.splatting.rendering import RenderedView

Array = npt.NDArray[np.float64]

FORMAT = "dentalsplat teeth 1"
#: Where the scene is more transparent than this it has no depth.
LEAST_ALPHA = 0.5
#: A crown needs depth at so many of its pixels to be placed.
LEAST_PIXELS = 4
#: Of a crown that goes on unseen a photograph shows a strip if that is a smaller share of the
#: pixels than where most of the crown is seen.
LEAST_PART = 0.5
#: Decimals of pixels and probabilities; of places, so many significant digits of their size.
_PIXEL_DECIMALS, _DOUBT_DECIMALS, _PLACE_DIGITS = 2, 4, 6
#: What another photograph is called in a reason, whatever name stands there.
_OTHER_PHOTO = re.compile(r"\bthe same as .*?(?=, which|$)")

NOTES = {
    "number": "FDI (ISO 3950): 11-48 permanent, 51-85 primary",
    "universal": "Universal numbering system: 1-32 permanent, A-T primary",
    "doubt": "0..1, that the number is wrong: of a tooth, the least of its photographs",
    "centre": "middle of what the photographs show of the crown's front, in the frame of all "
    "exports (scene.json); photographs that show a strip of it, or whose number is doubtful, count "
    "only where no other one shows it; null: nothing is known of its depth",
    "spread": "largest distance between that middle as single photographs have it and the centre; "
    "null: one photograph at most that counts",
    "width, height": "of the crown along and across its row, at its depth, in the photograph that "
    "shows most of it: it is foreshortened there, so the tooth has at least that; null: no "
    "photograph shows all of it",
    "outline": "closed polygon in pixels of the photograph as export.colmap writes it "
    "(colmap/images/PHOTOGRAPH.png), x to the right, y down, pixel centres at .5",
}


@dataclass(frozen=True)
class SeenCrown:
    """One crown in one placed photograph.

    Attributes:
        photograph: name of the view.
        number: FDI.
        doubt: 0..1, that the number is wrong.
        outline: [K, 2] pixels of the exported image.
        centre: [3] median of the surface inside the outline, frame of the exports, or None.
        pixels: where it has depth.
        width, height: in units of the exports, as this photograph shows them, or None.
        whole: neither side of it goes on unseen.
    """

    photograph: str
    number: int
    doubt: float
    outline: Array
    centre: Array | None
    pixels: int
    width: float | None = None
    height: float | None = None
    whole: bool = True


def describe_teeth(
    teeth: Teeth,
    views: Views,
    cameras: Sequence[Camera],
    seen: Sequence[RenderedView],
    frame: str,
    scale: Scale,
) -> dict[str, Any]:
    """The content of `teeth.json`. No file name of the user's is in it.

    A tooth's doubt is the least of its photographs': one that shows it surely is enough, for the
    cameras tie the others' crowns to it; each photograph's own doubt stands beside its outline. Its
    centre is the mean of what the photographs say, each with the weight of the pixels that it shows
    of the crown: the median over those pixels, for outlines take in a little gum and background.

    Args:
        teeth: the crowns, photograph by photograph.
        views: the photographs as the scene was made of them.
        cameras: of the placed ones, in the frame of the exports.
        seen: the scene as each of these cameras sees it.
        frame, scale: of the exports, as `scene.json` has them.
    """
    by_name = views.by_name()
    read = teeth.by_name()
    crowns: list[SeenCrown] = []
    placed = {camera.name for camera in cameras}
    for camera, rendered in zip(cameras, seen, strict=True):
        dentition = read.get(camera.name)
        if dentition is not None and not dentition.set_aside:
            crowns += _seen_crowns(dentition, by_name[camera.name], camera, rendered)
    numbers = sorted({crown.number for crown in crowns})
    shown = [_photograph(dentition, placed, by_name) for dentition in teeth.views]
    return {
        "format": FORMAT,
        "frame": frame,
        "units": scale.units,
        "scale": scale.as_dict(),
        "notes": NOTES,
        "teeth": [_tooth([c for c in crowns if c.number == number]) for number in numbers],
        "photographs": shown,
    }


def _seen_crowns(
    dentition: Dentition, view: View, camera: Camera, rendered: RenderedView
) -> list[SeenCrown]:
    """The numbered crowns of one placed photograph with their places."""
    size = camera.width, camera.height
    known = np.isfinite(rendered.depth) & (rendered.depth > 0) & (rendered.alpha >= LEAST_ALPHA)
    known &= view.valid()
    world = camera.unproject(np.where(known, rendered.depth, 0))
    found = []
    for crown in dentition.all_crowns:
        if not crown.number or len(crown.outline) < 3:
            continue
        outline = outline_in_view(crown.outline, dentition.size, view)
        inside = known & filled((replace(crown, outline=outline),), size)
        pixels = int(inside.sum())
        centre = np.median(world[inside], axis=0) if pixels >= LEAST_PIXELS else None
        width, height = _seen_size(crown, dentition, view, camera, centre)
        found.append(
            SeenCrown(
                camera.name, crown.number, crown.doubt, outline, centre, pixels, width, height,
                whole=not (crown.cut_left or crown.cut_right),
            )
        )  # fmt: skip
    return found


def _seen_size(
    crown: Crown, dentition: Dentition, view: View, camera: Camera, centre: Array | None
) -> tuple[float | None, float | None]:
    """Width and height of a crown at its depth, as one photograph shows them.

    Nothing of a crown whose outline is weak or goes on unseen; an occlusal photograph shows how
    thick a tooth is, not how high.
    """
    if centre is None or crown.doubtful or crown.cut_left or crown.cut_right:
        return None, None
    depth = float(camera.project(centre[None])[1][0])
    unit = depth / camera.fx * view.width / dentition.size[0]
    occlusal = dentition.kind in ("upper", "lower")
    return crown.width * unit, None if occlusal else crown.height * unit


def _tooth(crowns: Sequence[SeenCrown]) -> dict[str, Any]:
    """One entry of `teeth`: all sightings of one number."""
    number = crowns[0].number
    centre, spread = joint_centre(crowns)
    return {
        "fdi": number,
        "universal": universal_number(number),
        "dentition": "primary" if is_primary(number) else "permanent",
        "jaw": "upper" if is_upper(number) else "lower",
        "doubt": _rounded(min(crown.doubt for crown in crowns)),
        "centre": None if centre is None else [_significant(value) for value in centre],
        "spread": None if spread is None else _significant(spread),
        "width": _largest(crown.width for crown in crowns),
        "height": _largest(crown.height for crown in crowns),
        "seen_in": [
            {
                "photograph": crown.photograph,
                "doubt": _rounded(crown.doubt),
                "outline": np.round(crown.outline, _PIXEL_DECIMALS).tolist(),
            }
            for crown in crowns
        ],
    }


def joint_centre(crowns: Sequence[SeenCrown]) -> tuple[Array | None, float | None]:
    """[3] mean of a tooth's centres by the pixels that show it, and how far they lie from it.

    Where two crowns of a photograph carry the number, one is another tooth: the surer one counts.
    A strip of a crown has another middle, and what carries the number doubtfully may be another
    tooth: both count only where no photograph shows the tooth better. The distance is None with
    fewer than two centres, both with none.
    """
    surest: dict[str, SeenCrown] = {}
    for crown in sorted(crowns, key=lambda crown: (crown.doubt, -crown.pixels)):
        if crown.centre is not None:
            surest.setdefault(crown.photograph, crown)
    known = [crown for crown in crowns if surest.get(crown.photograph) is crown]
    most = max((crown.pixels for crown in known), default=0)
    known = [
        crown
        for crown in known
        if (crown.whole or crown.pixels >= LEAST_PART * most) and crown.doubt <= DOUBT_SHOWN
    ] or known
    if not known:
        return None, None
    centres = np.array([crown.centre for crown in known])
    mean = np.average(centres, axis=0, weights=[crown.pixels for crown in known])
    spread = np.linalg.norm(centres - mean, axis=1).max() if len(known) > 1 else None
    return mean, spread


def _photograph(
    dentition: Dentition, placed: set[str], views: Mapping[str, View]
) -> dict[str, Any]:
    """One entry of `photographs`."""
    if dentition.set_aside:
        reason = without_names(dentition.set_aside, views)
    elif dentition.name not in placed:
        reason = "it could not be placed"
    else:
        reason = ""
    return {
        "name": dentition.name,
        "kind": dentition.kind,
        "used": not reason,
        "set_aside": reason,
        "unnumbered_crowns": sum(not crown.number for crown in dentition.all_crowns),
    }


def without_names(reason: str, views: Mapping[str, View]) -> str:
    """A reason in which no file is named: photographs have their neutral names, or none."""
    for view in sorted(views.values(), key=lambda view: -len(view.source_name)):
        if view.source_name:
            reason = reason.replace(view.source_name, view.name)
    known = "|".join(re.escape(name) for name in views)
    if known and re.search(rf"\bthe same as ({known})(?=, which|$)", reason):
        return reason
    return _OTHER_PHOTO.sub("the same as another photograph", reason)


def _largest(sizes: Iterable[float | None]) -> float | None:
    known = [size for size in sizes if size is not None]
    return _significant(max(known)) if known else None


def _rounded(doubt: float) -> float:
    return round(float(doubt), _DOUBT_DECIMALS)


def _significant(value: float) -> float:
    return float(f"{value:.{_PLACE_DIGITS}g}")
