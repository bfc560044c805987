"""What may lie where the workspace keeps something of its own: other things than it put there."""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

from pipeline.errors import RequestError
from pipeline.untrusted.own import ASIDE, POINTER, RESULTS, has_results


def is_there(path: Path) -> bool:
    """Is there anything under a name, be it a link that leads nowhere?"""
    return os.path.lexists(path)


def is_folder(path: Path) -> bool:
    """Is it a folder itself, not a link to one?"""
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except OSError:
        return False


def remove(path: Path) -> None:
    """Delete whatever is under a name, or nothing; links, not what they lead to."""
    if is_folder(path):
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    if not is_folder(path):
        return path.lstat().st_size if is_there(path) else 0
    return sum(
        entry.lstat().st_size for entry in path.rglob("*") if not is_folder(entry)
    )  # fmt: skip


def set_aside(path: Path) -> Path:
    """Rename something that is in the way; returns where it is now."""
    number = 0
    while is_there(target := path.with_name(f"{path.name}{ASIDE}{number or ''}")):
        number += 1
    path.rename(target)
    return target


def make_folder(path: Path) -> Path:
    """A folder of the workspace's own: what else is under its name goes."""
    if not is_folder(path):
        remove(path)
        path.mkdir(exist_ok=True)
    return path


def free_for_file(path: Path) -> Path:
    """A name for a file of the workspace's own: a folder or a link under it is set aside."""
    if path.is_symlink() or (is_there(path) and not path.is_file()):
        set_aside(path)
    return path


def check_place(folder: Path) -> None:
    """Make sure that a folder that is to be written into is none of a workspace's results.

    What lies there is thrown away with them, and `results` is passed on: no names belong into it.

    Raises:
        RequestError: it is one, or lies in one.
    """
    there = Path(os.path.realpath(folder))  # which a link in a circle does not stop
    for place in (there, *there.parents, folder.absolute()):
        computed = place.name == RESULTS or is_there(place / POINTER)
        if computed and has_results(place.parent):
            raise RequestError(
                f"{folder} belongs to the results of the workspace {place.parent}, and whatever "
                "else is put there goes with them. Choose another folder with -o (or -w)."
            )


def stage_folder(root: Path, stage: str) -> Path:
    """The folder of a stage in a workspace, made if it isn't there. It may be a link to a folder.

    Raises:
        RequestError: something else has its name.
    """
    folder = root / stage
    if not folder.is_dir():
        if is_there(folder):
            what = "a link that leads nowhere" if folder.is_symlink() else "no folder"
            raise RequestError(
                f"{folder} is {what}, but {root} keeps a folder of its own under this name. Move "
                "it away, or choose another workspace with -w (or -o), and run the same command "
                "again."
            )
        folder.mkdir(parents=True, exist_ok=True)
    return folder
