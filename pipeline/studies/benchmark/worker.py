"""One cell in a process of its own: ``python -m`` of this module, a job on stdin.

So the peak memory and the seconds of a cell are its own, imports included, and what kills one cell
(the kernel, for its memory) is an entry in the tables and not the end of the benchmark.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from pipeline.front.progress import LineReporter
from pipeline.process.privacy import kept_for, private_from_now_on
from pipeline.store import write_sealed
from pipeline.studies.benchmark.cells import Cell, record_path, run_cell, unfinished_record


class CellReporter(LineReporter):
    """A line now and then, beginning with the cell's description; the rest is in its record."""

    def __init__(self, cell: Cell) -> None:
        super().__init__(interval=20.0)
        self._cell = cell

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        self._last = time.monotonic()

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        if not cached:
            self._say(f"{stage} done in {figures['wall_seconds']:.1f} s")

    def message(self, text: str) -> None:
        """Notes are kept in the record."""

    def _say(self, text: str) -> None:
        super()._say(f"  {self._cell.describe()}: {text}")


def main() -> None:
    """Run the job that stands in the first line of standard input."""
    job: dict[str, Any] = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cell, out = Cell.from_dict(job["cell"]), Path(job["out"])
    private_from_now_on()
    try:
        with kept_for(job["share"]):
            record = run_cell(cell, out, job["threads"], CellReporter(cell))
    except Exception as error:  # outside of any stage; it must not leave a trace on the terminal
        where = traceback.extract_tb(error.__traceback__)[-1]
        record = unfinished_record(
            cell,
            f"A fault of ours: {type(error).__name__}: {error} ({Path(where.filename).name}, line "
            f"{where.lineno}). Please report it.",
        )
    with kept_for(job["share"]):
        write_sealed(record_path(cell, out), record)


def _end_with_parent() -> None:
    """Standard input ends when the benchmark ends or is killed; the store survives this exit."""
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
