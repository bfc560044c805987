"""Who may read a workspace: what other versions and other programs left open is closed."""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path

from pipeline.process.privacy import Share, tighten
from pipeline.store.locks import LOCK
from pipeline.store.places import ASIDE, is_folder, is_there

#: What a workspace and the folders of a benchmark and a batch hold besides the folders of stages.
_OWN = {
    LOCK, "request.json", "pages.json", "results", "report.html", "report_anonymous.html",
    "check.html", "teeth.yaml", "logs", "profile", "compare", "dicom", "register",
    "cells", "results.json", "tables.md", "tables.csv", "batch.json", "summary.csv", "summary.html",
}  # fmt: skip


def tighten_workspace(root: Path, share: Share, more: Collection[str] = ()) -> list[Path]:
    """Give a workspace to those who may read it, and nobody else.

    The folder itself stays as it is where it holds other things too, such as the photographs.

    Args:
        more: names of further folders that are the workspace's own.

    Returns:
        What could not be changed.
    """
    failed: list[Path] = []
    alone = True
    for path in root.iterdir():
        if _is_own(path) or path.name in more:
            failed += tighten(path, share)
        elif not path.name.endswith(".tmp"):
            alone = False
    if alone:
        failed += tighten(root, share)
    return failed


def _is_own(path: Path) -> bool:
    if path.name in _OWN or ASIDE in path.name:
        return True
    return is_folder(path) and any(is_there(path / name) for name in (LOCK, "current.json"))


def tell(failed: list[Path]) -> None:
    """Say what others can still read."""
    if failed:
        more = f" and {len(failed) - 1} more" if failed[1:] else ""
        print(
            f"Others may be able to read {failed[0]}{more}: it belongs to another user or lies on "
            "a disk that knows no permissions. Patients' photographs belong elsewhere.",
            file=sys.stderr,
        )
