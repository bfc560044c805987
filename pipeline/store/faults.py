"""What a file system says, as errors of the user's: a full disk, a folder that can't be written."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from pipeline.errors import RequestError

#: No room on the disk, in the user's share of it, or for so large a file.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

#: The file system's answer where a file or a folder is not as it must be.
_IN_THE_WAY = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST,
    errno.ENOTEMPTY, errno.ELOOP, errno.ENAMETOOLONG, errno.EIO, errno.ESTALE, errno.ETXTBSY,
)  # fmt: skip


#: A file where a folder is to be made: 'File exists' sounds as if all were well.
_NO_FOLDER = {
    errno.EEXIST: "there is something else of that name",
    errno.ENOTDIR: "a part of its path is no folder",
}


def reason_of(error: OSError) -> str:
    """Why the file system refuses, as is said to the user."""
    if error.errno in _NO_FOLDER:
        return _NO_FOLDER[error.errno]
    return error.strerror or type(error).__name__


def is_full(error: BaseException) -> bool:
    """Does the file system say that there is no room?"""
    return isinstance(error, OSError) and error.errno in _FULL


def is_disk_full(error: BaseException, folder: Path) -> bool:
    """Did this error come from a full disk, whichever library reports it and however?"""
    if is_full(error):
        return True
    try:
        return shutil.disk_usage(folder).free < 2**20
    except OSError:
        return False


def file_in_the_way(error: BaseException, below: Path | None = None) -> RequestError | None:
    """What to tell the user where the file system refuses a file; None: that is not the matter.

    Args:
        below: only if the file is in this folder; there, one that has gone counts as well.
    """
    if not isinstance(error, OSError) or not isinstance(error.filename, str):
        return None
    known = (*_IN_THE_WAY, errno.ENOENT) if below is not None else _IN_THE_WAY
    if error.errno not in known:
        return None
    # of a rename it is the target that is in the way, of a temporary file its folder
    path = Path(error.filename2 if isinstance(error.filename2, str) else error.filename)
    path = path.parent if path.suffix == ".tmp" else path
    if below is not None and not Path(os.path.abspath(path)).is_relative_to(  # noqa: PTH100
        os.path.abspath(below)  # noqa: PTH100
    ):
        return None
    if error.errno == errno.ENOENT:
        return RequestError(
            f"{path} has gone while it was worked in: something else has moved or deleted it. Put "
            "back what was moved, and run the same command again; what is there is used again."
        )
    return RequestError(
        f"{path} can't be used ({reason_of(error)}). Mend its permissions, or move away what is in "
        "its place, and run the same command again; nothing that was computed is lost."
    )
