"""Threads of the kernels: how many, how they wait, and one caller at a time."""

from __future__ import annotations

import os
import threading

import numba
from numba.core import config

# OpenMP wakes its threads at once: numba's own work queue takes a tenth of a millisecond and more,
# at every kernel. It has to be chosen before the first parallel kernel runs.
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined]

#: The work queue, where OpenMP is missing, takes one caller at a time; whoever launches kernels
#: holds this lock.
KERNELS = threading.RLock()


def use_threads(threads: int | None) -> None:
    """Let the kernels of this process use `threads` threads (None: all there are)."""
    available = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(max(1, min(threads or available, available)))


def workers() -> int:
    """How many threads a kernel may use now."""
    return int(numba.get_num_threads())
