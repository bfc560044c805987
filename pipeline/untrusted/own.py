"""What runs keep in a folder: results of theirs, which are nobody's photographs.

A folder that somebody names may have a workspace below it, which holds pictures by the dozen:
previews, photographs at working size, renders. They are no photographs of a case.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

LOCK, POINTER, REQUEST, BATCH = ".lock", "current.json", "request.json", "batch.json"
RESULTS = "results"
#: Part of the name of what was set aside: `clean` deletes it.
ASIDE = ".quarantined"
#: What a workspace and the folders of a benchmark and a batch hold besides the folders of stages.
_NAMES = {
    LOCK, REQUEST, "pages.json", RESULTS, "report.html", "report_anonymous.html",
    "check.html", "teeth.yaml", "logs", "profile", "compare", "dicom", "register",
    "cells", "results.json", "tables.md", "tables.csv", BATCH, "summary.csv", "summary.html",
}  # fmt: skip
#: Files that are written into `dicom`, where an archive's photographs may lie instead.
_DICOM_FILES = ("preview.dcm", "view_[0-9][0-9][0-9].dcm", "mesh*.dcm", "model*.dcm")
#: Folders of a batch that hold no cases and whose names are not ours alone.
_OF_A_BATCH = {"records", "thumbnails"}


def has_results(folder: Path) -> bool:
    """Has a run or a batch put there what it made, or left its results?"""
    signs = (REQUEST, BATCH, f"{RESULTS}/scene.json")
    return any(os.path.lexists(folder / sign) for sign in signs)


def is_own(path: Path) -> bool:
    """Is something, where runs keep what they made, of that, and not of what else lies there?"""
    if path.name in _NAMES or ASIDE in path.name:
        return True
    if path.name in _OF_A_BATCH and os.path.lexists(path.parent / BATCH):
        return True
    return path.is_dir() and any(os.path.lexists(path / name) for name in (LOCK, POINTER))


def is_made(path: Path) -> bool:
    """Is something, where runs keep what they made, of that, and no folder of photographs?"""
    if path.name == "dicom" and not any(any(path.glob(files)) for files in _DICOM_FILES):
        return False
    return is_own(path)


def made_around(path: Path) -> Iterator[Path]:
    """The folders that a file lies in of those that hold what runs have made."""
    return (folder for folder in path.parents if has_results(folder.parent) and is_made(folder))
