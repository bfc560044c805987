"""Run a suite: every cell that is not finished, then the tables."""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pipeline.config import parse_override
from pipeline.config.asked import each_override
from pipeline.errors import RequestError, shown
from pipeline.files import write_json
from pipeline.installed import module_command
from pipeline.measure import usable_cores
from pipeline.process.privacy import Share, kept_for, share_for
from pipeline.stage import get_stage
from pipeline.store import read_own, write_sealed
from pipeline.store.places import remove, stage_folder
from pipeline.studies.benchmark.cells import (
    Cell,
    finished_record,
    plan_cells,
    record_path,
    unfinished_record,
)
from pipeline.studies.benchmark.report import benchmark_report
from pipeline.studies.benchmark.results import FORMAT, machine, versions_in_use
from pipeline.studies.benchmark.suite import LoadedSuite, load_suite
from pipeline.studies.benchmark.tables import build_table, paper_note
from pipeline.studies.benchmark.writing import write_tables
from pipeline.studies.jobs import only_one
from pipeline.untrusted.paths import given_path

#: How the process of one cell is started.
WORKER = module_command("pipeline.studies.benchmark.worker")

Say = Callable[[str], None]


def benchmark(
    suite: str | Path,
    *,
    out: str | Path | None = None,
    data: str | Path | None = None,
    jobs: int = 1,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    share: Share | None = None,
    say: Say | None = None,
    verbose: bool = False,
) -> dict[str, Any]:
    """Run scenes x methods x view counts x seeds and write the paper's tables of them.

    Every cell goes through the store, in one workspace per scene, number of views and seed, so that
    what methods share is computed once. A finished cell is not run again until something that it
    was computed from changes. A method that can't reconstruct the data is a result.

    Args:
        suite: name of a suite that comes with dentalsplat, or a YAML file.
        out: folder for workspaces and results; default ``./runs/benchmark_<suite>``. It gets
            ``tables.md``, ``tables.csv``, ``results.json`` and ``report.html``.
        data: folder where the scenes' paths begin, instead of the one that the suite names.
        jobs: workspaces at a time, a process each; the cores are divided between them.
        overrides: settings for all cells: ``{"fit.iterations": 9}`` or ``["fit.iterations=9"]``.
        share: who else may read the folder; None: as it is already.
        say: hears a line per cell. None: nothing is said, of what goes on in the cells neither.
        verbose: the cells' processes say each step, keys and memory on standard error.

    Returns:
        What ``results.json`` holds (see `pipeline.studies.benchmark.results`); `problems` names the
        cells that failed by a fault of ours or of the suite.

    Raises:
        RequestError: the suite is wrong, its data are missing, or `out` can't be used.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise RequestError(f"jobs is how many workspaces at a time, 1 at least; not {shown(jobs)}.")
    given_path(suite, "suite")
    loaded = load_suite(suite, None if data is None else given_path(data, "data"))
    cells, tables = plan_cells(loaded, dict(map(parse_override, each_override(overrides))))
    folder = (
        given_path(out, "out")
        if out is not None
        else Path("runs") / f"benchmark_{loaded.path.stem}"
    )
    threads = max(1, usable_cores() // jobs)
    places = {cell.workspace.partition("/")[0] for cell in cells}
    alone = only_one(folder.absolute(), "benchmark", places, "Wait for it")
    with kept_for(share_for(folder, share)), alone as place:
        stage_folder(place, "cells")
        told = {"threads": threads, "quiet": say is None, "verbose": verbose}
        records = _run_all(cells, place, jobs, told, say or (lambda text: None))
        results = _results(loaded, cells, tables, records, machine(jobs, threads))
        write_json(place / "results.json", results)
        write_tables(results, place)
        _write_report(results, place, say or (lambda text: None))
    return results


def _write_report(results: dict[str, Any], out: Path, say: Say) -> None:
    """Write the report; whatever goes wrong with it is said, and harms nothing else."""
    try:
        benchmark_report(results, out)
    except Exception as error:
        say(f"The report could not be written: {error}")


def _run_all(
    cells: list[Cell], out: Path, jobs: int, told: Mapping[str, Any], say: Say
) -> dict[str, dict[str, Any]]:
    """Bring every cell to its record; cells of one workspace run one after the other.

    Args:
        told: what the job of every cell says (`pipeline.studies.benchmark.worker`).
    """
    records = {}
    waiting: dict[str, list[Cell]] = {}
    for cell in cells:
        record = finished_record(cell, out)
        if record is not None:
            records[cell.id] = record
        else:
            waiting.setdefault(cell.workspace, []).append(cell)
    if records:
        say(f"{len(records)} of {len(cells)} cells are finished already")
    processes = _Processes()
    done = len(records)

    def work(queue: list[Cell]) -> None:
        nonlocal done
        for cell in queue:
            record = processes.run(cell, out, told)
            if record is None:
                return
            with processes.lock:
                records[cell.id] = record
                done += 1
                say(f"[{done}/{len(cells)}] {cell.describe()}: {outcome(record)}")

    with ThreadPoolExecutor(jobs) as pool:
        try:
            for future in [pool.submit(work, queue) for queue in waiting.values()]:
                future.result()
        except BaseException:
            processes.stop()
            raise
    return records


class _Processes:
    """The processes of the cells that are being run."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self._stopped = False

    def run(self, cell: Cell, out: Path, told: Mapping[str, Any]) -> dict[str, Any] | None:
        """Run one cell in a process; None if the benchmark is being stopped."""
        path = record_path(cell, out)
        remove(path)
        job = {"cell": cell.to_dict(), "out": str(out), "share": share_for(out), **told}
        status = self._status(job)
        if status is None:
            return None
        record = read_own(path)
        if record is not None:
            return record
        how = f"signal {-status}" if status < 0 else f"exit status {status}"
        if status == -9:
            how += ", as the system does when memory runs out"
        record = unfinished_record(
            cell, f"The process of this cell ended without a result ({how})."
        )
        write_sealed(path, record)
        return record

    def _status(self, job: dict[str, Any]) -> int | None:
        """How the process of a job ended; None if the benchmark is being stopped."""
        with self.lock:
            if self._stopped:
                return None
            process = subprocess.Popen(
                WORKER, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
            )
            self._running.add(process)
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(job) + "\n")
            process.stdin.flush()
        status = process.wait()
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        with self.lock:
            self._running.discard(process)
            return None if self._stopped else status

    def stop(self) -> None:
        """End what runs. The store survives a kill at any moment."""
        with self.lock:
            self._stopped = True
            for process in self._running:
                process.kill()


def outcome(record: Mapping[str, Any]) -> str:
    """What came of a cell, in one line."""
    if record["status"] != "done":
        return f"{record['status']}: {record['reason']}"
    figures = record["figures"]
    scoring = next(name for name in ("refined", "registered", "input") if name in figures)
    what = "the input views" if scoring == "input" else f"unseen views ({scoring} test poses)"
    return (
        f"{figures[scoring]['psnr']:.2f} dB on {what}, {record['registered']} of "
        f"{record['total']} views placed, {record['seconds']:.0f} s"
    )


def _results(
    loaded: LoadedSuite,
    cells: list[Cell],
    tables: Mapping[str, list[str]],
    records: Mapping[str, dict[str, Any]],
    measured_on: dict[str, Any],
) -> dict[str, Any]:
    suite = loaded.suite
    names = {name for cell in cells for name in cell.stages}
    libraries = {library for name in names for library in get_stage(name).libraries}
    return {
        "format": FORMAT,
        "title": suite.title,
        "note": " ".join(filter(None, [suite.note, paper_note(suite)])),
        "suite": suite.model_dump(mode="json"),
        "versions": versions_in_use(libraries),
        "machine": measured_on,
        "cells": [records[cell.id] for cell in cells],
        "tables": [
            build_table(suite, table, [records[i] for i in dict.fromkeys(tables[table.name])])
            for table in suite.tables
        ],
        "problems": [
            f"{cell.describe()}: {records[cell.id]['reason']}"
            for cell in cells
            if records[cell.id]["status"] in ("fault", "refused")
        ],
    }
