"""What of a workspace can go: results that are not in use, and what killed runs left."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from filelock import Timeout

from pipeline.store.failures import EVIDENCE, FAILURE
from pipeline.store.locks import lock_of
from pipeline.store.places import is_folder, is_there, remove, size_of
from pipeline.store.results import KEY_LENGTH
from pipeline.untrusted.own import ASIDE, LOCK

#: Ends the name of the folder that a result is written into.
PARTIAL = ".partial"
#: What a killed run leaves to go on from.
SCRATCH = "scratch"
#: Names of folders of results, and of those that are written, replaced or set aside.
_OWN = re.compile(rf"[0-9a-f]{{{KEY_LENGTH}}}(\..*)?")


def clean(
    root: Path,
    keep: int,
    in_use: Callable[[str], str | None],
    spare: Collection[str],
    manifest: str,
) -> tuple[list[str], int]:
    """Delete what is not in use from the folders of a workspace that nobody is working in.

    Args:
        keep: so many of the newest other results of each stage stay.
        in_use: stage -> name of the folder of the result in use; None: that is not known any more,
            and all of its results stay.
        spare: names (``stage/folder``) of what stays besides.
        manifest: name of the file that makes a folder a result.

    Returns:
        Names of what was deleted, and the bytes freed.
    """
    removed: list[str] = []
    freed = 0
    for folder in stage_folders(root):
        try:
            with lock_of(folder).acquire(timeout=0):
                for victim in _unused(folder, keep, in_use(folder.name), manifest):
                    name = f"{folder.name}/{victim.name}"
                    if name not in spare:
                        freed += size_of(victim)
                        removed.append(name)
                        remove(victim)
        except Timeout:
            continue
    return removed, freed


def stage_folders(root: Path) -> Iterator[Path]:
    """The folders of a workspace in which stages have worked."""
    for folder in sorted(root.iterdir()):
        if is_folder(folder) and is_there(folder / LOCK):
            yield folder


def checkpoints(root: Path) -> dict[str, int]:
    """Name (``stage/folder``) -> bytes of what stopped runs left to go on from."""
    return {
        f"{folder.name}/{partial.name}": size_of(partial)
        for folder in stage_folders(root)
        for partial in sorted(folder.glob(f"*{PARTIAL}"))
        if holds_checkpoint(partial)
    }


def holds_checkpoint(partial: Path) -> bool:
    """Is there something to go on from in the folder of a stopped run?

    What ends in ``.tmp`` is half written, or was of use to that run alone.
    """
    scratch = partial / SCRATCH
    return is_folder(scratch) and any(path.suffix != ".tmp" for path in scratch.iterdir())


def _is_own(path: Path) -> bool:
    """Is it the store's by its name, and nothing that a user has put there?"""
    name = path.name
    return ASIDE in name or (is_folder(path) and (name == EVIDENCE or bool(_OWN.fullmatch(name))))


def _unused(folder: Path, keep: int, in_use: str | None, manifest: str) -> list[Path]:
    entries = [path for path in folder.iterdir() if _is_own(path)]
    if is_there(folder / FAILURE):  # which names what is kept there
        entries = [path for path in entries if path.name != EVIDENCE]
    whole = [path for path in entries if (path / manifest).is_file() and "." not in path.name]
    others = sorted(
        (path for path in whole if path.name != in_use),
        key=lambda path: ((path / manifest).stat().st_mtime_ns, path.name),
        reverse=True,
    )
    others = others[keep:] if in_use is not None else []
    return [path for path in entries if path not in whole] + others
