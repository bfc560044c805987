"""Wall time, CPU time and peak memory of a piece of work."""

from __future__ import annotations

import time
from typing import Any

from pipeline import machine


class Measurement:
    """Use as a context manager; afterwards `figures` holds what was measured."""

    def __enter__(self) -> Measurement:
        self._resettable = machine.reset_peak()
        self._wall = time.perf_counter()
        self._cpu = machine.cpu_seconds()
        return self

    def __exit__(self, *_: object) -> None:
        self.figures: dict[str, Any] = {
            "wall_seconds": round(time.perf_counter() - self._wall, 3),
            "cpu_seconds": round(machine.cpu_seconds() - self._cpu, 3),
            "peak_memory_mb": round(machine.peak_mb(self._resettable), 1),
        }
