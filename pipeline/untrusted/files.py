"""Open a file of the user's: regular files only, never more bytes than its kind may have."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path


class UnusableFile(Exception):  # noqa: N818
    """Why a file can't be used, as the end of a sentence that starts with its name."""


@dataclass(frozen=True)
class Kind:
    """A kind of file from outside.

    Attributes:
        name: what messages call it.
        most_bytes: no larger one is read; far above what a real one has.
    """

    name: str
    most_bytes: int


#: 300 megapixels of 16-bit RGBA without compression are 2.2 GiB, the largest that is decoded.
PHOTOGRAPH = Kind("a photograph", 5 << 29)
#: Films are read in pieces: their length costs time, not memory.
FILM = Kind("a film", 1 << 40)
#: A scan of both jaws has 10 to 100 MB.
MESH = Kind("a mesh", 1 << 30)
#: Cameras, images and points of COLMAP: 10,000 images with their matches.
MODEL = Kind("a model", 1 << 31)
#: Cameras in `transforms.json`: 100,000 frames.
CAMERA_LIST = Kind("a list of cameras", 1 << 26)
#: Arrays of one pair of photographs at full size.
ARRAYS = Kind("arrays", 1 << 31)
#: Settings, suites, labels of teeth: read by a parser that takes its time.
SETTINGS = Kind("a text of settings", 1 << 20)
#: What is only hashed.
ANY = Kind("a file", 1 << 44)

_SORTS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def sort_of(mode: int) -> str | None:
    """What stands under a name that is no regular file, from its mode; None for a file."""
    if stat.S_ISREG(mode):
        return None
    return next((name for is_sort, name in _SORTS if is_sort(mode)), "no file")


@contextmanager
def opened(path: Path, kind: Kind) -> Iterator[BufferedReader]:
    """A file of the user's to read from; what its name leads to through links counts.

    Args:
        path: the file.
        kind: what it should be.

    Raises:
        UnusableFile: it can't be opened, is no regular file (a pipe would make the run wait for
            ever), or is too large.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for its other end.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | _BINARY)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise UnusableFile(f"can't be read ({reason})") from error
    found = os.fstat(descriptor)
    sort = sort_of(found.st_mode)
    if sort is not None:  # before fdopen, which has errors of its own for folders
        os.close(descriptor)
        raise UnusableFile(f"is {sort}, not a file")
    with os.fdopen(descriptor, "rb") as file:
        if found.st_size > kind.most_bytes:
            raise UnusableFile(
                f"has {found.st_size / 1e6:,.0f} MB, more than {kind.name} may have "
                f"({kind.most_bytes / 1e6:,.0f} MB)"
            )
        yield file


def read(path: Path, kind: Kind) -> bytes:
    """All bytes of a file of the user's.

    Raises:
        UnusableFile: as `opened`, or it grew while it was read.
    """
    with opened(path, kind) as file:
        try:
            # As many as are there: memory is taken for all that are asked for.
            size = os.fstat(file.fileno()).st_size
            data = file.read(size + 1)
        except OSError as error:
            raise UnusableFile(f"can't be read ({error.strerror or error})") from error
    if len(data) > size:
        raise UnusableFile(f"grew while it was read (it had {size:,} bytes)")
    return data


_BINARY: int = getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
