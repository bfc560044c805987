"""The page `check.html`: what was taken for which tooth, to put right by a click."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.dental.corrections import (
    CORRECTIONS,
    Corrections,
    PhotoCorrection,
    composed,
    corrections_file,
    read_corrections,
)
from pipeline.artifacts.teeth import UNREAD, Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views, to_uint8
from pipeline.errors import PICTURES, PipelineError
from pipeline.pages.case import Case
from pipeline.pages.page import CHECK, write_page
from pipeline.pages.pictures import picture
from pipeline.untrusted.own import BATCH

Content = dict[str, Any]

#: Numbers are marked from this doubt on.
DOUBTFUL = 0.1
TEMPLATE = "check.html"
#: Long side in pixels of a photograph on the page, and of one without teeth.
LARGE, SMALL = 1280, 480
#: Digits of a photograph's SHA-256 by which the corrections know it.
DIGITS = 16
#: Numbers offered for a crown.
MOST_OFFERED = 5
_NOTHING = ("no teeth were found in it", "its teeth have not been read")
#: Of a removed crown that is not read any more.
_NO_CROWN: Content = {
    "jaw": "upper", "outline": [], "number": 0, "doubt": 1.0, "weak": False, "offered": [],
}  # fmt: skip
#: The setting that names a file of corrections.
LABELS = "init.dental.labels"


def write_check_page(case: Case) -> bool:
    """Write the page where there are teeth to check, and take away one that no longer holds.

    Returns:
        Is there a page?

    Raises:
        RequestError: the folder can't be written to.
    """
    from stages.init.report import teeth_of

    out = case.workspace / CHECK
    teeth, views = teeth_of(case), _views_of(case)
    if teeth is None or views is None:
        out.unlink(missing_ok=True)
        return False
    path, corrections, problem = _corrections(case)
    own = path is None or path.parent.resolve() == case.workspace.resolve()
    write_page(
        "pipeline.studies.report", TEMPLATE, out, title=case.workspace.resolve().name,
        data=content(teeth, views, corrections, case.load("teeth", "teeth"))
        | {"command": command(case), "target": "" if own else str(path), "batch": of_batch(case)},
        failure=(case.failed.failure or "").partition(PICTURES)[0]
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
    section: Any = case.settings.get("init")
    setting = getattr(getattr(section, "dental", None), "labels", None)
    path = None
    try:
        path = corrections_file(setting, {"workspace": case.workspace}, LABELS)
        return path, read_corrections(path) if path else Corrections(), ""
    except PipelineError as error:
        return path, Corrections(), str(error)


def content(
    teeth: Teeth, views: Views, corrections: Corrections, read: Teeth | None = None
) -> Content:
    """What the page's script works on, as JSON values.

    Args:
        teeth: as the last run left them.
        views: the photographs.
        corrections: what was put right before.
        read: the teeth as the photographs have them; None: not known.
    """
    by_name, as_read = teeth.by_name(), read.by_name() if read else {}
    earlier = corrections.photographs
    labels = {composed(label): label for label in earlier}
    photographs = []
    for view in views.views:
        seen = by_name.get(view.name) or Dentition(view.name, (view.width, view.height), "none")
        names = (view.source_name, view.source_name.rpartition(".")[0], view.name)
        label = next(
            (labels[name] for name in map(composed, names) if name in labels),
            view.source_name or view.name,
        )
        if seen.kind == UNREAD and label not in earlier:
            continue  # there is nothing to check
        said = earlier.get(label, PhotoCorrection())
        if not said.is_of(view.source_sha256):
            said = PhotoCorrection()
        before = as_read.get(view.name) or Dentition(view.name, seen.size, "none")
        photographs.append(_photograph(view, seen, before, label, said))
    digest = hashlib.sha256(json.dumps(photographs).encode()).hexdigest()
    return {
        "file": CORRECTIONS, "doubtful": DOUBTFUL, "photographs": photographs, "digest": digest,
    }  # fmt: skip


def _photograph(
    view: View, seen: Dentition, read: Dentition, label: str, earlier: PhotoCorrection
) -> Content:
    from stages.dentition.corrections import LEFT_OUT, crowns_before

    before = [
        [_crown(crown) for crown in crowns]
        for crowns in crowns_before(read, view, earlier, bool(seen.mirrored))
    ]
    removed = [
        {"at": list(change.at)} | (was[0] if was else _NO_CROWN)
        for change, was in zip(earlier.crowns, before, strict=True) if change.remove
    ]  # fmt: skip
    # What a person has left out is taken back to what was read.
    aside = read.set_aside if seen.set_aside == LEFT_OUT else seen.set_aside
    gone = [crown["outline"] for crown in removed]
    crowns = [_crown(crown) for crown in seen.all_crowns if len(crown.outline) >= 3]
    shown = picture(
        to_uint8(view.image), label, long_side=LARGE if seen.all_crowns else SMALL
    )  # fmt: skip
    upright_from_shown = np.linalg.inv(view.working_from_upright)
    return {
        "name": label,
        "sha256": view.source_sha256[:DIGITS],
        "picture": shown.uri,
        "width": view.width,
        "height": view.height,
        "scale": upright_from_shown.diagonal()[:2].tolist(),
        "corner": upright_from_shown[:2, 2].tolist(),
        "mirrored": bool(seen.mirrored),
        "roll": round(float(seen.roll), 4),
        "kind": seen.kind,
        "aside": aside or ("" if seen.all_crowns else _NOTHING[seen.kind == UNREAD]),
        "crowns": [crown for crown in crowns if crown["outline"] not in gone],
        "removed": removed,
        "earlier": _entries(earlier, before),
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


def _entries(photo: PhotoCorrection, before: list[list[Content]]) -> Content:
    """Corrections as they stand in the file, so that a new file can keep them.

    Args:
        before: the crowns that each is about as they were before it, to take it back.
    """
    crowns: list[Content] = []
    for change, was in zip(photo.crowns, before, strict=True):
        entry: Content = {"at": list(change.at), "was": was}
        if change.tooth is not None:
            entry["tooth"] = change.tooth
        elif change.split is not None:
            entry["split"] = [list(place) for place in change.split]
        else:
            entry["remove"] = True
        crowns.append(entry)
    said = {"use": photo.use, "kind": photo.kind, "mirrored": photo.mirrored}
    return said | {"crowns": crowns}


def of_batch(case: Case) -> bool:
    """Is it a case of a batch? Then that has to run it again: `pipeline run` would leave its
    summary as it is, and finds nothing to go on from where only results are kept."""
    cases = case.workspace.resolve().parent
    return cases.name == "cases" and (cases.parent / BATCH).is_file()


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
