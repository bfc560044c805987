"""The link that shows the exports in use."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from pipeline.files import folder_listing, temporary_beside
from pipeline.store.places import is_folder, is_there, remove, set_aside
from pipeline.store.records import MANIFEST, DamagedError, read_manifest

#: What a disk without symbolic links (exFAT) answers.
NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)


def link_to(root: Path, name: str, folder: Path, stage: str) -> tuple[Path, Path | None]:
    """Point ``root/name`` at an artifact's folder, by a relative link.

    What a copy of the workspace made a folder of becomes a link again; any other folder or file of
    that name is set aside.

    Returns:
        The link, and where what stood in its place was moved to.
    """
    link, aside = root / name, None
    target = os.path.relpath(folder, root)
    if link.is_symlink() and os.readlink(link) == target:  # noqa: PTH115
        return link, None
    if is_folder(link) and _is_copy(link, root / stage, folder.name):
        remove(link)
    elif is_there(link) and not link.is_symlink():
        aside = set_aside(link)
    temporary = temporary_beside(link)
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    temporary.replace(link)
    return link, aside


def _is_copy(folder: Path, stage: Path, kind: str) -> bool:
    """Does a folder hold what a result of a stage holds, byte for byte?"""
    listing = folder_listing(folder)
    for path in stage.glob(f"*/{MANIFEST}"):
        with suppress(DamagedError):
            outputs = (read_manifest(path) or {}).get("outputs", {})
            if kind in outputs and outputs[kind]["files"] == listing:
                return True
    return False
