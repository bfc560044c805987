"""What a Dask worker does: start one process for one case, and watch its memory and its time."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

from pipeline.files import read_json
from pipeline.installed import library_version, module_command
from pipeline.process.privacy import kept_for
from pipeline.store.places import remove
from pipeline.studies.batch.child import DISK_FULL
from pipeline.studies.batch.keep import thumbnail_of
from pipeline.studies.batch.records import (
    FINAL,
    Case,
    new_record,
    read_case,
    write_case,
)
from pipeline.untrusted.own import BATCH

#: So often is a case begun whose process was killed from outside, before it is given up.
TRIES = 3
#: Seconds between two looks at the memory of a case.
WATCH = 0.25
#: How the process of a case is started; tests have another.
COMMAND: tuple[str, ...] = ()

_lock = threading.Lock()
_running: dict[int, tuple[str, subprocess.Popen[str]]] = {}
_stopped: set[str] = set()


def look(out: str, batch: str) -> str:
    """Whether this machine can work on a batch: empty, or what is in the way."""
    try:
        found = read_json(Path(out) / BATCH)
    except OSError:
        found = None
    if not isinstance(found, dict) or found.get("id") != batch:
        return (
            f"The worker on {socket.gethostname()} does not see the folder {out} of this batch, or "
            "may not read it. Workers on other machines need a shared file system, on which "
            "photographs and results have the same paths everywhere, and run as the same user."
        )
    version = library_version("dentalsplat")
    if found.get("version") != version:
        return (
            f"The worker on {socket.gethostname()} has dentalsplat {version}, the batch was "
            f"started with {found.get('version')}. Install the same version on all machines."
        )
    return ""


def run_case(job: dict[str, Any]) -> dict[str, Any]:
    """Bring a case to its record; called on a worker.

    Returns:
        The record; or ``{"state": "unseen" or "full", "reason"}``, which ends the batch.
    """
    out, case = Path(job["out"]), Case.from_dict(job["case"])
    trouble = look(job["out"], job["batch"])
    if trouble:
        return {"state": "unseen", "reason": trouble}
    memory = _memory() if job["memory"] is None else job["memory"]
    job = {**job, "threads": job["threads"] or _threads(), "memory": memory}
    tries = 0
    while True:
        before = _record(job, case)
        lost = before["attempts"] if before is not None and before["state"] == "running" else 0
        if max(lost, tries) >= TRIES:
            return _ended(
                job, case, "killed",
                f"Its process, or the worker that had started it, was killed from outside {TRIES} "
                f"times, as a system does where memory runs out. Look into logs/{case.id}.txt, "
                "give it a machine with more memory or fewer --jobs, and run with --retry failed.",
                tries,
            )  # fmt: skip
        status, limit = _process(job, case)
        tries += 1
        if job["session"] in _stopped:
            return new_record(case, "stopped")
        if limit:
            return _ended(job, case, "killed", limit, tries)
        if status == DISK_FULL:
            return {"state": "full", "reason": _full(out)}
        record = _record(job, case)
        if record is not None and record["state"] in FINAL:
            return record
        if status >= 0:
            return _ended(
                job, case, "fault",
                f"A fault of ours: its process ended without a result (exit status {status}). What "
                f"it said last stands in logs/{case.id}.txt.",
                tries,
            )  # fmt: skip


def _record(job: dict[str, Any], case: Case) -> dict[str, Any] | None:
    """What this batch has found out about exactly this case; None: nothing yet."""
    record = read_case(Path(job["out"]), case.id)
    if record is None or record["session"] != job["session"]:
        return None
    same = record["settings"] == job["settings"] and record["files"] == case.stamps
    return record if same else None


def stop(session: str) -> None:
    """End all cases of a batch that this process has started; what they computed is kept."""
    with _lock:
        _stopped.add(session)
        for owner, process in list(_running.values()):
            if owner == session:
                _kill(process)


def _process(job: dict[str, Any], case: Case) -> tuple[int, str]:
    """Run a case once.

    Returns:
        Exit status, negative for a signal; and the limit that it was ended for, if it was.
    """
    out = Path(job["out"])
    with kept_for(job["share"]), (out / "logs" / f"{case.id}.txt").open("a") as log:
        log.write(f"-- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}\n")
        log.flush()
        with _lock:
            if job["session"] in _stopped:
                return -signal.SIGTERM, ""
            process = subprocess.Popen(
                COMMAND or module_command("pipeline.studies.batch.child"), stdin=subprocess.PIPE,
                stdout=log, stderr=log, text=True, process_group=0,
            )  # fmt: skip
            _running[process.pid] = job["session"], process
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(job) + "\n")
            process.stdin.flush()
        limit = _watch(process, job["memory"], job["seconds"])
        status = process.wait()
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        return status, limit
    finally:
        with _lock:
            _running.pop(process.pid, None)
        _kill(process)


def _watch(process: subprocess.Popen[str], memory: int, seconds: float) -> str:
    """Wait for the end of a case; end it where it goes beyond a limit.

    Args:
        memory: bytes of all its processes together. 0: no limit.
        seconds: 0: no limit.

    Returns:
        Why it was ended; empty where it ended by itself.
    """
    start = time.monotonic()
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(WATCH)
            return ""
        if memory and (taken := _memory_of(process.pid)) > memory:
            _kill(process)
            return (
                f"It took more memory than it may: {taken / 1e9:.2f} of {memory / 1e9:.2f} GB. Run "
                "it again with a larger --memory (or fewer --jobs) and --retry failed; or with "
                "smaller or fewer photographs (--set views.long_side=512, --set views.frames=12)."
            )
        if seconds and time.monotonic() - start > seconds:
            _kill(process)
            return (
                f"It took more time than it may: {seconds / 60:.3g} minutes. Run it again with a "
                "larger --minutes and --retry failed: it goes on where it was."
            )


def _memory_of(pid: int) -> int:
    """Bytes that a process and all that it started hold; what they share counts for each."""
    import psutil

    total = 0
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        for each in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += each.memory_info().rss
    return total


def _kill(process: subprocess.Popen[str]) -> None:
    """End a case with all that it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _ended(job: dict[str, Any], case: Case, state: str, reason: str, tries: int) -> dict[str, Any]:
    """The record of a case whose process left none."""
    out, before = Path(job["out"]), _record(job, case)
    record = new_record(
        case, state, reason, settings=job["settings"], session=job["session"],
        host=socket.gethostname(), contents=before["contents"] if before else [],
        attempts=max(before["attempts"] if before else 0, tries),
    )  # fmt: skip
    with kept_for(job["share"]):
        remove(thumbnail_of(out, case.id))
        write_case(out, record)
    return record


def _full(out: Path) -> str:
    return (
        f"The disk that holds {out} is full. Nothing that was computed is lost: make room ('--keep "
        "results' keeps a tenth of each case) and run the same command again."
    )


def _threads() -> int:
    """Cores for one case, where the batch does not say: those of this worker, by its slots."""
    from distributed import get_worker

    from pipeline.measure import usable_cores

    return max(1, usable_cores() // get_worker().state.nthreads)


def _memory() -> int:
    """Bytes for one case, where the batch does not say: those of this worker, by its slots; 0 where
    it has no limit."""
    from distributed import get_worker

    worker = get_worker()
    return int((worker.memory_manager.memory_limit or 0) / worker.state.nthreads)
