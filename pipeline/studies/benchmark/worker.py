"""One cell in a process of its own: ``python -m`` of this module, a job on stdin.

So the peak memory and the seconds of a cell are its own, imports included, and what kills one cell
(the kernel, for its memory) is an entry in the tables and not the end of the benchmark.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from pipeline.front.progress import LineReporter
from pipeline.process.privacy import kept_for, private_from_now_on
from pipeline.running.outcomes import StageOutcome
from pipeline.running.reporter import Reporter
from pipeline.store import write_sealed
from pipeline.studies.benchmark.cells import Cell, record_path, run_cell, unfinished_record
from pipeline.studies.jobs import given_job, told_fault


class CellReporter(LineReporter):
    """A line now and then, beginning with the cell's description; the rest is in its record."""

    def __init__(self, cell: Cell, *, verbose: bool = False) -> None:
        super().__init__(interval=5.0 if verbose else 20.0, verbose=verbose)
        self._cell = cell

    def foreseen(self, stages: list[StageOutcome]) -> None:
        if self._verbose:
            super().foreseen(stages)

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        if self._verbose:
            super().stage_started(stage, reasons, resumed)
        self._last = time.monotonic()

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        if self._verbose:
            super().stage_finished(stage, cached, figures)
        elif not cached:
            self._say(f"{stage} done in {figures['wall_seconds']:.1f} s")

    def message(self, text: str) -> None:
        if self._verbose:  # they are kept in the record, too
            super().message(text)

    def _say(self, text: str) -> None:
        super()._say(f"  {self._cell.describe()}: {text.strip()}")


def main() -> None:
    """Run the job that stands in the first line of standard input."""
    job = given_job()
    private_from_now_on()
    run_job(job)


def run_job(job: dict[str, Any]) -> None:
    """Bring one cell to its record."""
    cell, out = Cell.from_dict(job["cell"]), Path(job["out"])
    try:
        with kept_for(job["share"]):
            record = run_cell(cell, out, job["threads"], _reporter(cell, job))
    except Exception as error:  # outside of any stage; it must not leave a trace on the terminal
        record = unfinished_record(cell, told_fault(error))
    with kept_for(job["share"]):
        write_sealed(record_path(cell, out), record)


def _reporter(cell: Cell, job: dict[str, Any]) -> Reporter:
    return Reporter() if job["quiet"] else CellReporter(cell, verbose=job["verbose"])


if __name__ == "__main__":
    main()
