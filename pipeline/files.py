"""Files that survive a kill, a full disk or a power cut, and the hashes that identify them."""

from __future__ import annotations

import hashlib
import json
import os
import socket
import threading
from pathlib import Path
from typing import Any

from pipeline.untrusted.names import storable


def canonical_json(value: Any) -> str:
    """JSON with one spelling per value: sorted keys, no spaces, no NaN."""
    text = json.dumps(
        value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False
    )
    return storable(text)


def sha256_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_file(path: Path) -> str:
    """Hash a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def fsync_folder(folder: Path) -> None:
    """Make the names inside a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_tree(folder: Path) -> None:
    """Make every file and every folder below `folder` durable."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            descriptor = os.open(os.path.join(parent, name), os.O_RDONLY)  # noqa: PTH118
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        fsync_folder(Path(parent))


def temporary_beside(path: Path) -> Path:
    """A name of this thread's own beside a file, to write to before it replaces the file.

    What a kill leaves under such a name `remove_leftovers` knows by the process in it.
    """
    owner = f"{os.getpid()}.{threading.get_ident()}@{socket.gethostname()}"
    return path.with_name(f".{path.name}.{owner}.tmp")


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes of this machine left in a folder and two levels below it."""
    for pattern in (".*.tmp", "*/.*.tmp", "*/*/.*.tmp"):
        for path in folder.glob(pattern):
            owner, _, host = path.name.removesuffix(".tmp").rpartition("@")
            process = owner.split(".")[-2:-1]
            if host != socket.gethostname() or not process or not process[0].isdecimal():
                continue
            if not _is_running(int(process[0])):
                path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True


def make_writable(folder: Path) -> None:
    """Make a folder if it isn't there, and try that files can be written into it.

    Raises:
        OSError: they can't.
    """
    folder.mkdir(parents=True, exist_ok=True)
    probe = temporary_beside(folder / "write-test")
    probe.write_text("")
    probe.unlink()


def write_atomic(path: Path, text: str) -> None:
    """Replace a small text file in one step: a reader sees the old content or the new.

    Names of files that are no text are written as JSON would escape them.
    """
    temporary = temporary_beside(path)
    try:
        with temporary.open("w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
        fsync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """`write_atomic` of indented JSON."""
    write_atomic(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON, or return None where the file is missing or unreadable as JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError, UnicodeDecodeError):
        return None


def folder_listing(folder: Path) -> dict[str, dict[str, Any]]:
    """Relative name -> size and sha256 of every file below `folder`, in name order."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): {
            "size": path.stat().st_size,
            "sha256": sha256_file(path),
        }
        for path in files
    }


def content_hash(listing: dict[str, dict[str, Any]]) -> str:
    """One hash for a folder's names and bytes."""
    return sha256_text(canonical_json({name: entry["sha256"] for name, entry in listing.items()}))
