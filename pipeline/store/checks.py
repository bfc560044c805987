"""Are the files of a result those that were written? Every byte counts, and none is read in vain.

Beside a result's manifest lies `checked.json`: what the system said of each file (size, times of
its last change and of its inode's, inode) when its bytes were last read and found right. While the
system says the same, the bytes are not read again. Setting a file's time back does not hide a
change, since that changes its inode's time. What lies elsewhere than it did (a copy, another disk)
is read once, and so is everything where `checked.json` itself is not what was written. A disk that
changes bytes behind the system's back is found by ``--verify`` only, which reads everything.
"""

from __future__ import annotations

import contextlib
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.files import sha256_file
from pipeline.store.places import is_folder, remove
from pipeline.store.records import DamagedError, Record, read_record, write_sealed

MEMORY = "checked.json"
#: A file that changed this short a time ago may change again without the system noting another
#: time: file systems count in steps of up to two seconds.
SETTLED_NS = 2 * 10**9

#: size, mtime_ns, ctime_ns, inode
Mark = tuple[int, int, int, int]
Marks = dict[str, Mark]


@dataclass
class Known:
    """What is known of the files of a result.

    Attributes:
        outputs: what their manifest says of them, as one text.
        settled: marks of files whose bytes were read and found right, long enough after they
            changed last. These can be remembered.
        read_now: marks of the others, and of files that this process has written.
    """

    outputs: str
    settled: Marks = field(default_factory=dict)
    read_now: Mapping[str, Mark | None] = field(default_factory=dict)


class Memory(Record):
    """`checked.json`: the content hashes of the kinds, and the marks of their files."""

    contents: dict[str, str]
    files: dict[str, list[int]]


def files_of(manifest: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """(name below the result's folder, size and sha256) of every file of a result."""
    for kind, output in manifest["outputs"].items():
        for name, entry in output["files"].items():
            yield f"{kind}/{name}", entry


def mark_of(path: Path) -> Mark | None:
    """What the system says of a file; None: it is not there, or no file."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    if not stat.S_ISREG(found.st_mode):
        return None
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino


def damaged(
    folder: Path, manifest: Mapping[str, Any], known: Known, kinds: Iterable[str] | None = None
) -> list[str]:
    """Names of the files of a result that are not what its manifest says.

    Args:
        folder: of the result.
        known: of these files; what is found right here is added.
        kinds: look at these only.
    """
    wanted = None if kinds is None else set(kinds)
    wrong = []
    for name, entry in files_of(manifest):
        if wanted is not None and name.partition("/")[0] not in wanted:
            continue
        mark = mark_of(folder / name)
        if mark is None or mark[0] != entry["size"]:
            wrong.append(name)
        elif mark not in (known.settled.get(name), known.read_now.get(name)):
            latest = time.time_ns() - SETTLED_NS
            if _digest(folder / name) != entry["sha256"]:
                wrong.append(name)
            elif max(mark[1:3]) < latest:
                known.settled[name] = mark
            else:
                known.read_now = {**known.read_now, name: mark}
    return wrong


def _digest(path: Path) -> str | None:
    try:
        return sha256_file(path)
    except OSError:  # taken away meanwhile, not for us to read, or a bad spot of the disk
        return None


def remembered(folder: Path, manifest: Mapping[str, Any]) -> Marks:
    """The marks beside a result; none where they were kept of other content, or not by us."""
    try:
        memory = read_record(folder / MEMORY, Memory)
    except DamagedError:
        return {}
    if memory is None or memory.contents != _contents(manifest):
        return {}
    marks: Marks = {}
    for name, mark in memory.files.items():
        if len(mark) == 4:
            marks[name] = mark[0], mark[1], mark[2], mark[3]
    return marks


def remember(folder: Path, manifest: Mapping[str, Any], marks: Marks) -> None:
    """Keep marks beside a result; where that fails, all is read again."""
    files = {name: list(mark) for name, mark in marks.items()}
    value = {"contents": _contents(manifest), "files": files}
    with contextlib.suppress(OSError):
        if is_folder(folder / MEMORY):
            remove(folder / MEMORY)
        write_sealed(folder / MEMORY, value)


def _contents(manifest: Mapping[str, Any]) -> dict[str, str]:
    return {kind: output["content"] for kind, output in manifest["outputs"].items()}
