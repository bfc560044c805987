"""One case in a process of its own: ``python -m`` of this module, a job on standard input.

What takes too much memory or crashes is one line of the summary, not the end of the batch. The
store keeps what the stages computed, so a case whose process was killed goes on where it was.
"""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError, ReconstructionError, RequestError
from pipeline.files import canonical_json, sha256_file, sha256_text
from pipeline.front.commands import run
from pipeline.front.progress import LineReporter
from pipeline.measure import peak_mb_with_children
from pipeline.process.privacy import kept_for, private_from_now_on
from pipeline.running.outcomes import RunSummary
from pipeline.store import is_disk_full
from pipeline.store.faults import file_in_the_way
from pipeline.store.locks import lock_of
from pipeline.store.places import is_there, remove, size_of
from pipeline.studies.batch.keep import keep_results, kept_aside, thumbnail_of, write_thumbnail
from pipeline.studies.batch.records import (
    FINAL,
    Case,
    new_record,
    read_case,
    workspace_of,
    write_case,
)
from pipeline.studies.batch.sources import contents_of, settings_of, with_others
from pipeline.studies.jobs import given_job, told_fault

#: What the summary links to, where it is there: name -> place in a case's folder.
LINKS = {
    "viewer": "results/viewer.html", "report": "report.html", "check": "check.html",
    "results": "results",
}  # fmt: skip
#: Those that say what came of a run that failed.
PAGES = ("report", "check")
#: Exit status of a process that could not write because the disk is full.
DISK_FULL = 74


def main() -> None:
    """Run the job that stands in the first line of standard input."""
    job = given_job()
    with contextlib.suppress(OSError):  # where memory runs out, this goes and not the worker
        Path("/proc/self/oom_score_adj").write_text("1000")
    private_from_now_on()
    try:
        with kept_for(job["share"]):
            run_case(job)
    except Exception as error:
        out, case = Path(job["out"]), Case.from_dict(job["case"])
        if is_disk_full(error, out):
            sys.exit(DISK_FULL)
        told = closed_to_us(error, out)
        if not told:
            raise
        given = {"settings": job["settings"], "session": job["session"]}
        write_case(out, new_record(case, "wrong", told, **given))


def closed_to_us(error: BaseException, out: Path) -> str:
    """What is said of a case where the batch's own folder can't be written to; else nothing."""
    told = file_in_the_way(error, out)
    return f"{told} It counts as wrong until then: add --retry failed." if told else ""


def run_case(job: dict[str, Any]) -> dict[str, Any]:
    """Bring one case to its record, and return that.

    Another process that works on the same case is waited for; what it finds is taken.
    """
    case, out = Case.from_dict(job["case"]), Path(job["out"])
    workspace = workspace_of(out, case)
    workspace.mkdir(parents=True, exist_ok=True)
    with lock_of(workspace):
        before = read_case(out, case.id)
        record = new_record(case, "running", settings=job["settings"], session=job["session"])
        record["contents"], trouble = _contents(job, case, workspace)
        if before is not None and not (job["again"] and before["session"] != job["session"]):
            same = all(before[k] == record[k] for k in ("settings", "contents"))
            if before["state"] in FINAL and same and trouble is None:
                told = {"files": case.stamps, "name": case.name, "session": job["session"]}
                record = {**before, **told}
                record = _trimmed(record, job, workspace)
                write_case(out, record)
                return record
        attempts = before["attempts"] if before and before["session"] == job["session"] else 0
        record |= {"attempts": attempts + 1, "host": socket.gethostname()}
        write_case(out, record)
        thumbnail = thumbnail_of(out, case.id)
        remove(thumbnail)
        start = time.perf_counter()
        if trouble is None:
            record |= _outcome(job, case, workspace)
        else:
            record |= {"state": "wrong", "reason": trouble}
        if record["state"] == "stopped":
            write_case(out, record)
            sys.exit(DISK_FULL)
        record["seconds"] = round(time.perf_counter() - start, 2)
        record["peak_memory_mb"] = round(peak_mb_with_children(), 1)
        with contextlib.suppress(OSError):
            scene = record["state"] == "done"
            write_thumbnail(workspace, thumbnail, record["contents"], scene=scene)
        record["bytes"] = size_of(workspace)
        # First the record that it is done, then what is not needed: a kill between loses nothing.
        write_case(out, record)
        record = _trimmed(record, job, workspace)
        if record["kept"]:
            write_case(out, record)
    return record


def _contents(job: dict[str, Any], case: Case, workspace: Path) -> tuple[list[str], str | None]:
    """Name and hash of each photograph and of each other file that is read here; and why a
    photograph can't be read."""
    from stages.views.find import find_images

    try:
        photographs = find_images(case.images)
    except PipelineError as error:
        return [], str(error)
    found = []
    for label, path in photographs.items():
        try:
            found.append(f"views: {label} {sha256_file(path)}")
        except OSError as error:
            return [], f"{path} can't be read ({error.strerror or error})."
    stages = tuple(job["stages"]) if job["stages"] else None
    try:
        settings = settings_of(job["preset"], (*job["overrides"], *case.overrides), stages)
    except PipelineError as error:  # the run says so
        return [*sorted(found), str(error)], None
    here = with_others(case, settings, workspace)
    return [*sorted(found), *contents_of((*here.named, *here.put))], None


def _links(workspace: Path, names: Iterable[str]) -> dict[str, str]:
    """Those of these names that lead somewhere."""
    return {name: LINKS[name] for name in names if (workspace / LINKS[name]).exists()}


def _outcome(job: dict[str, Any], case: Case, workspace: Path) -> dict[str, Any]:
    """State, reason and figures of a run, whose progress goes into the log."""
    reporter = LineReporter(interval=5.0 if job["verbose"] else 20.0, verbose=job["verbose"])
    overrides = [*job["overrides"], *case.overrides, f"run.threads={job['threads']}"]
    try:
        with kept_aside(workspace):
            summary = run(
                case.images, workspace=workspace, preset=job["preset"], overrides=overrides,
                stages=job["stages"], share=job["share"], reporter=reporter,
            )  # fmt: skip
    except Exception as error:
        if is_disk_full(error, workspace) or (
            error.__cause__ is not None and is_disk_full(error.__cause__, workspace)
        ):
            return {"state": "stopped", "reason": str(error)}
        # where no stage had begun no page was written: one that is there shows an earlier run
        pages = PAGES if isinstance(error, PipelineError) and error.stage else ()
        links = _links(workspace, pages)
        return {"state": _state_of(error), "reason": _reason_of(error), "links": links}
    return {"state": "done", "links": _links(workspace, LINKS), **_figures(summary)}


def _state_of(error: Exception) -> str:
    if isinstance(error, ReconstructionError):
        return "refused"
    return "wrong" if isinstance(error, RequestError) else "fault"


def _reason_of(error: Exception) -> str:
    return str(error) if isinstance(error, PipelineError) else told_fault(error)


def _figures(summary: RunSummary) -> dict[str, Any]:
    """What stages say of themselves under the names that all use."""
    told: dict[str, Any] = {}
    warnings: list[str] = []
    for stage in summary.stages:
        told |= stage.figures["summary"]
        warnings += stage.warnings
    teeth, measured = None, {}
    if summary.results is not None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            found = json.loads((summary.results / "teeth.json").read_text())
            teeth, measured = len(found["teeth"]), _measured(found.get("measurements", ()))
    return {
        "teeth": teeth,
        "measured": measured,
        "photographs": told.get("views_total", told.get("views")),
        "placed": told.get("views_registered"),
        "psnr": told.get("psnr"),
        "ssim": told.get("ssim"),
        "warnings": warnings,
        "key": sha256_text(canonical_json([stage.key for stage in summary.stages])),
    }


def _measured(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Name -> value and uncertainty in mm, and whether it is estimated; of what has a value."""
    return {
        entry["name"]: {
            "value": entry["value"], "uncertainty": entry["uncertainty"],
            "estimated": entry["estimated"] is not None,
        }
        for entry in entries if entry["value"] is not None and entry["unit"] == "mm"
    }  # fmt: skip


def _trimmed(record: dict[str, Any], job: dict[str, Any], workspace: Path) -> dict[str, Any]:
    """The record after what is not to be kept of a case that went well has been deleted."""
    if job["keep"] != "results" or record["state"] != "done" or record["kept"]:
        return record
    if not is_there(workspace / "results") and not is_there(workspace / ".results"):
        return {**record, "left_out": [], "kept": "all"}  # it exports nothing: all is results
    left_out = keep_results(workspace)
    return {
        **record, "kept": "results", "left_out": left_out, "links": _links(workspace, LINKS),
        "bytes": size_of(workspace),
    }  # fmt: skip


if __name__ == "__main__":
    main()
