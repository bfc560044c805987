"""Reports: one self-contained HTML file per run and per benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

REPORT = "report.html"
#: The page to put the teeth right, written beside the report where teeth were numbered.
CHECK = "check.html"


def run_report(workspace: str | Path) -> Path:
    """Write ``WORKSPACE/report.html`` from what the workspace holds, and ``check.html`` beside it.

    Returns:
        The file.

    Raises:
        RequestError: the folder is not a workspace, or can't be written to.
    """
    from pipeline.report.run import write_run_report

    return write_run_report(Path(workspace))


def benchmark_report(results: dict[str, Any], out: str | Path) -> Path:
    """Write the report of a benchmark.

    Args:
        results: what `results.json` of the benchmark says.
        out: the benchmark's folder (the report is ``report.html`` in it).

    Returns:
        The file.
    """
    from pipeline.report.benchmark import write_benchmark_report

    return write_benchmark_report(results, Path(out))


__all__ = ["CHECK", "REPORT", "benchmark_report", "run_report"]
