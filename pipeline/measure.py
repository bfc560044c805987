"""The cores there are, and wall time, CPU time and peak memory of a piece of work.

On any system: some lack calls that Linux has.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from pathlib import Path
from typing import Any


def usable_cores() -> int:
    """How many cores this process may use; where the system can't say, how many there are.

    A container that is granted the time of so many cores (``docker run --cpus``, the limits of
    Kubernetes) sees all those of its machine: more threads than granted cores hold each other up.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, granted_cores())))


def granted_cores(groups: Path = Path("/sys/fs/cgroup")) -> float:
    """Cores whose time the container's control group grants, version 2 or 1; without limit inf."""
    try:
        if (both := groups / "cpu.max").exists():
            quota, period = both.read_text().split()
        else:
            quota, period = (
                (groups / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period")
            )
        granted = float(quota) / float(period)  # version 2 says "max", version 1 says -1
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
    return granted if granted > 0 else math.inf


def cpu_seconds() -> float:
    """Seconds of processor time of this process and, where the system counts them, its children."""
    try:
        import resource
    except ImportError:  # Windows
        times = os.times()
        return time.process_time() + times.children_user + times.children_system
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def reset_peak() -> bool:
    """Linux can forget the process's peak, so that each stage gets its own; whether it did."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak_mb_with_children() -> float:
    """The most memory that this process, or one that it has waited for, has held, in MiB."""
    own = peak_mb(False)
    try:
        import resource
    except ImportError:
        return own
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return max(own, children / (2**20 if sys.platform == "darwin" else 1024))


def peak_mb(resettable: bool) -> float:
    """The most memory this process has held, in MiB; 0 where the system can't say.

    Args:
        resettable: what `reset_peak` said: the peak since then, else since the process began.
    """
    if resettable:
        with contextlib.suppress(OSError):
            for line in Path("/proc/self/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) / 1024
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024  # bytes there, KiB elsewhere


def confine(memory: int) -> None:
    """Take from this process what it may do, where the system can, for as long as it lives.

    It opens and writes no more files, leaves no file of its memory behind, and is the first to go
    where the machine runs out of memory.

    Args:
        memory: bytes that it may take beyond what it has.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    try:
        import resource
    except ImportError:
        return
    with contextlib.suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for right in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE, resource.RLIMIT_NOFILE):
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(right, (0, 0))


class Measurement:
    """Use as a context manager; afterwards `figures` holds what was measured."""

    def __enter__(self) -> Measurement:
        self._resettable = reset_peak()
        self._wall = time.perf_counter()
        self._cpu = cpu_seconds()
        return self

    def __exit__(self, *_: object) -> None:
        self.figures: dict[str, Any] = {
            "wall_seconds": round(time.perf_counter() - self._wall, 3),
            "cpu_seconds": round(cpu_seconds() - self._cpu, 3),
            "peak_memory_mb": round(peak_mb(self._resettable), 1),
        }
