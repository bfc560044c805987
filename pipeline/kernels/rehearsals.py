"""Kernels compiled ahead: beside the first stages of a run, or for an image (`pipeline warmup`).

A stage names its rehearsals: functions that run its kernels on something tiny. Compiling is one
thread's work, so that processes share them: `python -m pipeline.kernels.rehearsals LENGTH` is such
a process, and holds one after the other until none is left in the pipe that they all read from. A
kernel that two need is compiled by one.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

from pipeline.kernels import folder as places
from pipeline.kernels.folder import SUFFIX
from pipeline.process.native import ONE_THREAD
from pipeline.process.signals import child

#: how much the run itself goes before
NICENESS = 10


class Background:
    """Processes that compile the kernels of stages to come, if they are not there yet."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[bytes]] = []

    def start(self, stages: Iterable[str], processes: int) -> None:
        """Begin; what can't be begun is left to the stages themselves."""
        waiting = missing(stages)
        if not waiting:
            return
        with contextlib.suppress(OSError), _pipe_of(waiting) as (names, length):
            for _ in range(min(processes, len(waiting))):
                self._running.append(_process(names, length))

    def wait(self) -> bool:
        """Wait for all of them; did all go well?"""
        statuses = [process.wait() for process in self._running]
        return not any(statuses)

    def stop(self) -> None:
        """End what still runs."""
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.wait()
        self._running = []


def missing(stages: Iterable[str]) -> list[str]:
    """Rehearsals of these stages that have not been held since anything changed."""
    from pipeline.stage import get_stage

    folders = places.readable()
    return [
        name
        for stage in stages
        for name in get_stage(stage).rehearsals
        if not any((folder / _mark(name)).is_file() for folder in folders)
    ]


def hold(name: str) -> None:
    """Hold a rehearsal here, and note it."""
    module, _, function = name.partition(":")
    getattr(importlib.import_module(module), function)()
    folder = places.writable()
    if folder is not None:
        (folder / _mark(name)).touch()
        places.for_all(folder / _mark(name))
        places.tidy(folder, f"rehearsed.{name.replace(':', '.')}")


@contextlib.contextmanager
def _pipe_of(names: Sequence[str]) -> Iterator[tuple[int, int]]:
    """The reading end of a pipe that ends after these names, and how many bytes each has there."""
    records = [name.encode() for name in names]
    length = max(map(len, records))
    reading, writing = os.pipe()
    try:
        with os.fdopen(writing, "wb") as end:
            end.write(b"".join(record.ljust(length) for record in records))
        yield reading, length
    finally:
        os.close(reading)


def _process(names: int, length: int) -> subprocess.Popen[bytes]:
    here = str(Path(__file__).resolve().parents[2])
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([here, *filter(None, sys.path)]),
        # nothing here is worth a second thread
        "NUMBA_NUM_THREADS": "1", **ONE_THREAD,
    }  # fmt: skip
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name, str(length)], env=environment,
        stdin=names, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _mark(name: str) -> str:
    return f"rehearsed.{name.replace(':', '.')}-{_state()}-{SUFFIX}"


@cache
def _state() -> str:
    """Hash of all that compiled kernels may depend on."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted([*(root / "stages").rglob("*.py"), *Path(__file__).parent.glob("*.py")]):
        digest.update(path.read_bytes())
    digest.update(repr((sys.version, version("numba"), version("llvmlite"))).encode())
    digest.update(_processor().encode())
    return digest.hexdigest()[:12]


def _processor() -> str:
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return repr(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    return platform.processor()


def main(length: int) -> None:
    child()
    with contextlib.suppress(AttributeError):  # Windows has none
        os.nice(NICENESS)
    while name := os.read(0, length).decode().strip():
        hold(name)


if __name__ == "__main__":
    main(int(sys.argv[1]))
