"""Where compiled kernels are kept, and what they were compiled from. Knows nothing of numba."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

#: compiled for so many states of the sources a kernel is kept: for going back and forth
KEPT = 3
SUFFIX = ".kernel"
#: `from MODULE import NAMES` and `import MODULES` at the left margin: what functions import may
#: not be there. A parser takes seventeen times as long.
_IMPORT = re.compile(
    r"^(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|.*)|import[ \t]+(.*))", re.MULTILINE
)
_NAME = re.compile(r"[\w.]+")


def folders() -> list[Path]:
    """Where to look for compiled kernels, and in this order where to keep them.

    Beside this file, where `pipeline warmup` puts them for all users of an image; in the user's
    cache; where there is neither, in a temporary folder of the user's. NUMBA_CACHE_DIR has the
    last word.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return [Path(chosen) / "dentalsplat"]
    found = [Path(__file__).resolve().parent / "__pycache__"]
    if os.environ.get("XDG_CACHE_HOME"):
        found.append(Path(os.environ["XDG_CACHE_HOME"]) / "dentalsplat" / "kernels")
    else:
        with contextlib.suppress(RuntimeError):  # a user without a home
            found.append(Path.home() / ".cache" / "dentalsplat" / "kernels")
    if hasattr(os, "getuid"):  # Windows has none, and a cache for each user
        found.append(Path(tempfile.gettempdir()) / f"dentalsplat-kernels-{os.getuid()}")
    return found


def readable() -> list[Path]:
    """Those of `folders` whose content can be trusted to be ours."""
    first, *rest = folders()
    return [folder for folder in (first, *filter(_ours, rest)) if folder.is_dir()]


def writable() -> Path | None:
    """The first of `folders` that can be written, made if need be; None: there is none."""
    for number, folder in enumerate(folders()):
        try:
            folder.mkdir(mode=0o700 if number else 0o777, parents=True, exist_ok=True)
            if number and not _ours(folder):
                continue
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


def for_all(path: Path) -> None:
    """What is kept beside the program is for all users, also where root's files are its own."""
    if path.parent == folders()[0] and not os.environ.get("NUMBA_CACHE_DIR"):
        for place, mode in ((path.parent, 0o755), (path, 0o644)):
            with contextlib.suppress(OSError):
                if place.stat().st_mode & mode != mode:
                    place.chmod(place.stat().st_mode | mode)


def _ours(folder: Path) -> bool:
    """Compiled code is run: nobody else may have put it there."""
    if not hasattr(os, "getuid"):
        return folder.is_dir()
    try:
        found = folder.lstat()
    except OSError:
        return False
    alone = stat.S_ISDIR(found.st_mode) and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return alone and found.st_uid == os.getuid()


def tidy(folder: Path, kernel: str) -> None:
    """Delete what was compiled from older states of the sources; `kernel` begins its files."""
    with contextlib.suppress(OSError):
        states: dict[str, list[Path]] = {}
        newest: dict[str, float] = {}
        for path in folder.glob(f"{kernel}-*{SUFFIX}"):
            state = path.name[len(kernel) + 1 :].partition("-")[0]
            states.setdefault(state, []).append(path)
            newest[state] = max(newest.get(state, 0.0), path.stat().st_mtime)
        for state in sorted(states, key=lambda s: -newest[s])[KEPT:]:
            for path in states[state]:
                path.unlink(missing_ok=True)


@cache
def source_digest(module: str) -> str:
    """Hash of a module's file and of the files of all modules of the project that it imports.

    A kernel is compiled together with the functions that it calls and the constants that it reads,
    from whichever file they come. To import a module of `stages` for kernels that have nothing to
    do with it costs no more than that they are compiled again when it changes.
    """
    projects = {"pipeline", "stages", module.partition(".")[0]}
    found: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        file = getattr(sys.modules.get(name), "__file__", None)
        if name in found or file is None or name.partition(".")[0] not in projects:
            continue
        found[name], imported = _read(file)
        waiting += imported
    return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()


@cache
def _read(file: str) -> tuple[str, list[str]]:
    """Hash of a file, and the names of what it imports: modules, and things in modules."""
    text = Path(file).read_text("utf-8")
    imported = []
    for module, names, modules in _IMPORT.findall(text):
        # a word too many, as what follows "as", is no module
        imported += _NAME.findall(modules)
        imported += [module, *(f"{module}.{name}" for name in _NAME.findall(names))]
    return hashlib.sha256(text.encode()).hexdigest(), imported
