"""The page `check.html`: what was taken for which tooth, to put right by a click."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.corrections import (
    CORRECTIONS,
    Corrections,
    PhotoCorrection,
    corrections_file,
    read_corrections,
)
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views, to_uint8
from pipeline.errors import PipelineError
from pipeline.report import CHECK
from pipeline.report.case import Case
from pipeline.report.names import labels_of
from pipeline.report.page import write_page
from pipeline.report.pictures import picture

Content = dict[str, Any]

#: Numbers are marked from this doubt on.
DOUBTFUL = 0.1
#: Long side in pixels of a photograph on the page, and of one without teeth.
LARGE, SMALL = 1280, 480
#: Numbers offered for a crown.
MOST_OFFERED = 5


def teeth_of(case: Case) -> Teeth | None:
    """The teeth of the last run: numbered, or kept by the stage that found them doubtful."""
    if case.failed is not None:
        kept: Teeth | None = case.evidence("teeth")
        if kept is not None:
            return kept if any(view.all_crowns for view in kept.views) else None
    latest: Teeth | None = case.latest("teeth")
    if latest is None or not any(c.number for view in latest.views for c in view.all_crowns):
        return None
    return latest


def write_check_page(case: Case) -> bool:
    """Write the page where there are teeth to check, and take away one that no longer holds.

    Returns:
        Is there a page?

    Raises:
        RequestError: the folder can't be written to.
    """
    out = case.workspace / CHECK
    teeth, views = teeth_of(case), _views_of(case)
    if teeth is None or views is None:
        out.unlink(missing_ok=True)
        return False
    path, corrections, problem = _corrections(case)
    own = path is None or path.parent.resolve() == case.workspace.resolve()
    write_page(
        "check.html", out, title=case.workspace.resolve().name,
        data=content(teeth, views, corrections)
        | {"command": command(case), "target": "" if own else str(path)},
        failure=(case.failed.failure or "").partition(" Pictures that show it: ")[0]
        if case.failed else "",
        problem=problem, doubtful=round(100 * DOUBTFUL), corrections=CORRECTIONS,
    )  # fmt: skip
    return True


def _views_of(case: Case) -> Views | None:
    """The photographs as they were read: later stages may mask or undistort them."""
    names = case.providers("views")
    found: Views | None = case.load(names[0], "views") if names else None
    return found


def _corrections(case: Case) -> tuple[Path | None, Corrections, str]:
    """The file of corrections, what it says today, and what is wrong with it."""
    section: Any = case.config.sections.get("init") if case.config else None
    setting = getattr(getattr(section, "dental", None), "labels", None)
    path = None
    try:
        path = corrections_file(setting, {"workspace": case.workspace})
        return path, read_corrections(path) if path else Corrections(), ""
    except PipelineError as error:
        return path, Corrections(), str(error)


def content(teeth: Teeth, views: Views, corrections: Corrections) -> Content:
    """What the page's script works on, as JSON values."""
    by_name = teeth.by_name()
    earlier = corrections.photographs
    photographs = []
    for view in views.views:
        seen = by_name.get(view.name) or Dentition(view.name, (view.width, view.height), "none")
        names = (view.source_name, view.source_name.rpartition(".")[0], view.name)
        label = next((name for name in names if name in earlier), view.source_name or view.name)
        photographs.append(_photograph(view, seen, label, earlier.get(label, PhotoCorrection())))
    return {"file": CORRECTIONS, "doubtful": DOUBTFUL, "photographs": photographs}


def _photograph(view: View, seen: Dentition, label: str, earlier: PhotoCorrection) -> Content:
    shown = picture(
        to_uint8(view.image), label, long_side=LARGE if seen.all_crowns else SMALL
    )  # fmt: skip
    upright = view.upright_size
    return {
        "name": label,
        "picture": shown.uri,
        "width": view.width,
        "height": view.height,
        "scale": [upright[0] / view.width, upright[1] / view.height],
        "mirrored": bool(seen.mirrored),
        "roll": round(float(seen.roll), 4),
        "kind": seen.kind,
        "aside": seen.set_aside or ("" if seen.all_crowns else "no teeth were found in it"),
        "doubts": list(seen.doubts),
        "crowns": [_crown(crown) for crown in seen.all_crowns if len(crown.outline) >= 3],
        "earlier": _entries(earlier),
    }


def _crown(crown: Crown) -> Content:
    offered = sorted(crown.numbers.items(), key=lambda item: (-item[1], item[0]))[:MOST_OFFERED]
    return {
        "jaw": crown.jaw,
        "outline": np.round(crown.outline, 1).tolist(),
        "number": crown.number,
        # 0 where a person has said the number, and only there.
        "doubt": max(round(float(crown.doubt), 3), 0.001) if crown.doubt else 0.0,
        "weak": bool(crown.doubtful),
        "offered": [[tooth, round(float(share), 3)] for tooth, share in offered],
    }


def _entries(photo: PhotoCorrection) -> Content:
    """Corrections as they stand in the file, so that a new file can keep them."""
    crowns: list[Content] = []
    for change in photo.crowns:
        entry: Content = {"at": list(change.at)}
        if change.tooth is not None:
            entry["tooth"] = change.tooth
        elif change.split is not None:
            entry["split"] = [list(place) for place in change.split]
        else:
            entry["remove"] = True
        crowns.append(entry)
    said = {"use": photo.use, "kind": photo.kind, "mirrored": photo.mirrored}
    return said | {"crowns": crowns}


def command(case: Case) -> list[str]:
    """The command that runs the request again, but for the workspace, which the page knows itself.

    Returns:
        What comes before the workspace's folder and what comes after it, quoted for a shell.
    """
    request: Mapping[str, Any] = case.request
    after = []
    if request.get("preset"):
        after += ["-c", request["preset"]]
    if request.get("stages"):
        after += ["--stages", ",".join(request["stages"])]
    for text in request.get("overrides", []):
        after += ["--set", text]
    return ["pipeline run -w", shlex.join(after)]


def labelled(case: Case) -> Content | None:
    """The labelled photographs for the report, and which were set aside for what."""
    teeth = teeth_of(case)
    if teeth is None:
        return None
    labels = labels_of(case)
    drawn = []
    for view in teeth.views:
        image = teeth.pictures.get(view.name)
        if image is not None and not view.set_aside:
            title = labels.get(view.name, view.name)
            numbered = sum(bool(crown.number) for crown in view.all_crowns)
            said = f"{title}: {view.kind}, {numbered} of {len(view.all_crowns)} teeth numbered"
            caption = ". ".join([said, *(doubt.rstrip(".") for doubt in view.doubts)]) + "."
            drawn.append(picture(image, said, caption, 900))
    aside = [
        (labels.get(view.name, view.name), view.set_aside) for view in teeth.views if view.set_aside
    ]
    return {"pictures": drawn, "set_aside": aside}
