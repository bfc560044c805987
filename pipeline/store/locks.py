"""One process at a time works on a stage of a workspace; the others say for whom they wait."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.files import write_atomic
from pipeline.process.privacy import share_for
from pipeline.store.places import free_for_file, is_folder, set_aside
from pipeline.store.records import DamagedError, Owner, read_record
from pipeline.untrusted.own import LOCK

OWNER = ".owner.json"


def lock_of(folder: Path) -> FileLock:
    """The lock of a folder, not acquired yet; what else is under its name is set aside."""
    mode = 0o640 if share_for(folder) == "group" else 0o600  # filelock heeds no mask
    return FileLock(free_for_file(folder / LOCK), mode=mode)


@contextmanager
def locked(folder: Path, stage: str, on_wait: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of a stage's folder; if another process has it, say whose it is and wait."""
    lock, owner_file = lock_of(folder), folder / OWNER
    try:
        lock.acquire(timeout=0)
    except Timeout:
        on_wait(f"waiting for {_owner(owner_file, stage)}")
        lock.acquire(poll_interval=0.2)
    try:
        if is_folder(owner_file):
            set_aside(owner_file)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        owner = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
        write_atomic(owner_file, json.dumps(owner) + "\n")
        yield
    finally:
        with suppress(OSError):
            owner_file.unlink(missing_ok=True)
        lock.release()


def _owner(file: Path, stage: str) -> str:
    try:
        owner = read_record(file, Owner)
    except DamagedError:
        owner = None
    who, since = ("another process", "")
    if owner is not None:
        who, since = f"process {owner.pid} on {owner.host}", f" since {owner.since}"
    return f"{who}, which has been working on '{stage}'{since}"
