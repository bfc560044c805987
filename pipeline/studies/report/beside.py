"""The report drawn by a process of its own, beside the last stages of a run.

At each line ``draw`` on its standard input it draws what is new, and keeps that. At ``write`` all
stages are done: it writes the pages, and answers on its standard output with one line of JSON,
``{"error": null}`` or why they could not be written.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path

from pipeline.pages.page import compile_template
from pipeline.pages.remembered import remember
from pipeline.studies.report import check, run, run_report
from pipeline.studies.report.reading import read_case

DRAW, WRITE = "draw\n", "write\n"
#: How much the stages themselves go before it.
NICENESS = 10


def draw_ahead(workspace: Path, drawn: set[Path]) -> None:
    """Draw what can be drawn by now; whatever fails is told when the pages are written.

    Args:
        drawn: folders of the results that have been; those added are entered.
    """
    with contextlib.suppress(Exception):
        for template in (run.TEMPLATE, check.TEMPLATE):
            compile_template("pipeline.studies.report", template)
        case = read_case(workspace)
        for record in case.stages:
            if record.result is not None and record.result.folder not in drawn:
                drawn.add(record.result.folder)
                run.part_of_stage(case, record.name)


def main(workspace: Path) -> None:
    with contextlib.suppress(AttributeError):  # Windows has none
        os.nice(NICENESS)
    remember()
    drawn: set[Path] = set()
    for line in sys.stdin:
        if line == DRAW:
            draw_ahead(workspace, drawn)
        elif line == WRITE:
            error = None
            try:
                run_report(workspace)
            except Exception as raised:
                error = str(raised) or type(raised).__name__
            print(json.dumps({"error": error}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
