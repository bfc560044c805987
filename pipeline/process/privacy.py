"""Who may read what is written: the owner, or also the owner's group. Photographs are patients'.

The system has one file mask per process. The command line sets it once, for good, before anything
is written. The functions of `import pipeline` set it while they run and put it back (`kept_for`):
files that other threads of the caller write meanwhile are kept from others too, which errs on the
safe side. Files that libraries write obey the mask as well.

A workspace remembers whom it is for by the mode of a file in it that is always its own (`_TELLING`:
0640 is for the group too, anything else for the owner alone), or of its folder where there is none
yet; the folder alone won't do, since it may be the user's own and stay as it is. No setting and no
key knows of it.
"""

from __future__ import annotations

import contextlib
import os
import stat
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Literal, get_args

from pipeline.errors import RequestError

Share = Literal["nobody", "group"]
SHARES: tuple[Share, ...] = get_args(Share)

#: What is taken away from whoever is not the owner.
_MASKS: dict[Share, int] = {"nobody": 0o077, "group": 0o027}

#: Files of which every workspace, stage, batch, and benchmark has one.
_TELLING = ("request.json", ".lock")

_inherited: ContextVar[Share | None] = ContextVar("share", default=None)
_lock = threading.Lock()
_masks: list[int] = []
_before = 0


def private_from_now_on() -> None:
    """For a process of ours: what it writes is the owner's alone unless `kept_for` says more."""
    os.umask(_MASKS["nobody"])


@contextlib.contextmanager
def kept_for(share: Share) -> Iterator[None]:
    """What is written inside, by any thread, may be read by these only.

    Where two threads are inside for different people, the stricter holds for both.
    """
    global _before
    mask = _MASKS[share]
    with _lock:
        _masks.append(mask)
        previous = os.umask(_strictest())
        if len(_masks) == 1:
            _before = previous
    token = _inherited.set(share)
    try:
        yield
    finally:
        _inherited.reset(token)
        with _lock:
            _masks.remove(mask)
            os.umask(_strictest() if _masks else _before)


def _strictest() -> int:
    mask = 0
    for each in _masks:
        mask |= each
    return mask


def share_for(folder: Path, asked: Share | None = None) -> Share:
    """For whom a workspace is.

    Args:
        asked: what the user says; None: as what is going on around this, else as the folder is.

    Raises:
        RequestError: it is for nobody that there is.
    """
    if asked is not None:
        if asked not in SHARES:
            raise RequestError(f"share is {' or '.join(SHARES)}; this is {asked!r}.")
        return asked
    inherited = _inherited.get()
    if inherited is not None:
        return inherited
    for place in (*(folder / name for name in _TELLING), folder):
        with contextlib.suppress(OSError):
            mode = place.stat().st_mode
            if stat.S_ISREG(mode):
                return "group" if mode & 0o047 == 0o040 else "nobody"
            if stat.S_ISDIR(mode):
                return "group" if mode & 0o057 == 0o050 else "nobody"
    return "nobody"


def tighten(path: Path, share: Share) -> list[Path]:
    """Give a file, or a folder with all in it, to those who may read it; links are left alone.

    A folder comes after what is in it: one that is as it should be need not be looked into.

    Returns:
        What could not be changed.
    """
    try:
        mode = path.lstat().st_mode
    except OSError:
        return []
    if stat.S_ISLNK(mode) or mode == _wanted(mode, share):
        return []
    failed: list[Path] = []
    if stat.S_ISDIR(mode):
        for parent, folders, files in os.walk(path, topdown=False):
            for name in (*folders, *files):
                failed += _change(Path(parent, name), share)
    return failed + _change(path, share)


def _change(path: Path, share: Share) -> list[Path]:
    try:
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and mode != _wanted(mode, share):
            path.chmod(stat.S_IMODE(_wanted(mode, share)))
    except FileNotFoundError:  # another process has taken it away
        return []
    except OSError:
        return [path]
    return []


def _wanted(mode: int, share: Share) -> int:
    group = 0
    if share == "group":
        group = 0o050 if stat.S_ISDIR(mode) else 0o040
    return mode & ~0o077 | group
