"""What studies do alike: a folder of their own, jobs in processes, faults told."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from filelock import Timeout

from pipeline.errors import RequestError
from pipeline.files import make_writable
from pipeline.store import Store
from pipeline.store.faults import reason_of
from pipeline.store.locks import lock_of
from pipeline.store.places import check_place
from pipeline.untrusted.names import readable


@contextlib.contextmanager
def only_one(folder: Path, study: str, within: Iterable[str], wait: str) -> Iterator[Path]:
    """Make the folder of a study and keep others out of it.

    Args:
        folder: where it works.
        study: what it is, as in ``Another batch``.
        within: folders in it that stages have theirs in.
        wait: what to say of the other one, as in ``Wait for it``.
    """
    Store(folder).create(more=within)
    lock = lock_of(folder)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RequestError(
            f"Another {study} is working in {folder}. {wait}, or choose another folder: -o."
        ) from None
    try:
        yield folder
    finally:
        lock.release()


@contextlib.contextmanager
def results_in(folder: Path) -> Iterator[None]:
    """Make the folder that results are to be written into; without any in the end it goes again.

    Raises:
        RequestError: it can't be written to, as is to be known before the work, or belongs to the
            results of a workspace.
    """
    check_place(folder)
    new = not folder.exists()
    try:
        make_writable(folder)
    except OSError as error:
        raise RequestError(
            f"{folder} can't be written to ({reason_of(error)}). Name another folder with -o."
        ) from error
    try:
        yield
    finally:
        if new:
            with contextlib.suppress(OSError):  # it holds some
                folder.rmdir()


def given_job() -> dict[str, Any]:
    """The job in the first line of standard input; this process ends when that does.

    It does when the parent ends or is killed. The store survives this exit.
    """
    job: dict[str, Any] = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return job


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


def told_fault(error: Exception) -> str:
    """What is said of a fault of ours outside of any stage."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return readable(
        f"A fault of ours: {type(error).__name__}: {error} ({Path(where.filename).name}, line "
        f"{where.lineno}). Please report it."
    )
