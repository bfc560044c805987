"""Who may read a workspace: what other versions and other programs left open is closed."""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path

from pipeline.process.privacy import Share, tighten
from pipeline.untrusted.own import is_own


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
        if is_own(path) or path.name in more:
            failed += tighten(path, share)
        elif not path.name.endswith(".tmp"):
            alone = False
    if alone:
        failed += tighten(root, share)
    return failed


def tell(failed: list[Path]) -> None:
    """Say what others can still read."""
    if failed:
        more = f" and {len(failed) - 1} more" if failed[1:] else ""
        print(
            f"Others may be able to read {failed[0]}{more}: it belongs to another user or lies on "
            "a disk that knows no permissions. Patients' photographs belong elsewhere.",
            file=sys.stderr,
        )
