"""Run a batch: every case that is not finished, and a summary at every moment."""

from __future__ import annotations

import contextlib
import math
import queue
import time
import uuid
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from pipeline.config import anchored
from pipeline.config.asked import anchored_preset, each_override, each_stage
from pipeline.errors import RequestError, shown
from pipeline.files import write_json
from pipeline.installed import library_version
from pipeline.measure import usable_cores
from pipeline.process.privacy import Share, kept_for, share_for
from pipeline.store.places import remove, stage_folder
from pipeline.studies.batch.child import closed_to_us
from pipeline.studies.batch.cluster import check_workers, connected, require_dask, slots
from pipeline.studies.batch.keep import thumbnail_of
from pipeline.studies.batch.plan import Plan, check_folder, make_plan
from pipeline.studies.batch.progress import Lines, Silent, by_state
from pipeline.studies.batch.records import (
    FAILED,
    FOLDERS,
    Case,
    new_record,
    read_case,
    write_case,
)
from pipeline.studies.batch.summary import write_summary
from pipeline.studies.batch.task import run_case, stop
from pipeline.studies.jobs import only_one
from pipeline.untrusted.names import readable
from pipeline.untrusted.own import BATCH
from pipeline.untrusted.paths import given_path

Keep = Literal["workspace", "results"]
KEEPS: tuple[Keep, ...] = get_args(Keep)

#: Seconds between two looks at how the cases stand, and between two summaries.
TICK, SUMMARY = 0.5, 5.0


def batch(
    cases: str | Path,
    *,
    out: str | Path | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    preset: str | Path | None = None,
    overrides: Iterable[str] | Mapping[str, Any] = (),
    stages: Sequence[str] | None = None,
    retry: Sequence[str] = (),
    keep: Keep = "workspace",
    memory: float | None = None,
    minutes: float | None = None,
    share: Share | None = None,
    progress: Lines | None = None,
) -> dict[str, Any]:
    """Run the pipeline on many cases, each in a process of its own; finished ones stay as they are.

    Args:
        cases: a folder with a folder of photographs (or a film) for each case, or a CSV file.
        out: folder for workspaces and summary; default ``./runs/batch_<name of the cases>``.
        jobs: cases at a time on this machine; the cores are divided between them.
        scheduler: address or file of a Dask scheduler, to run on its workers instead.
        preset, overrides, stages: as `run` has them, for all cases.
        retry: ``failed``, or names of cases: run these again though they came to an end.
        keep: ``results``: of a case that went well only these are kept, at most 8 to 12 MB.
        memory: gigabytes that the processes of one case may take; None: an equal share of the
            machine, or what a worker was given; 0: as much as there is.
        minutes: that one case may take; None: as many as it needs.
        share: who else may read the folder; None: as it is already.
        progress: hears how it goes.

    Returns:
        ``{"folder", "cases": [record, ...], "counts": {state: number}, "seconds"}``.

    Raises:
        RequestError: the request is wrong, the folder is that of other cases, another batch works
            in it, the disk is full, or the scheduler is gone.
    """
    require_dask()
    retry = [retry] if isinstance(retry, str) else retry
    _check(jobs, keep, memory, minutes, retry)
    texts = tuple(map(anchored, each_override(overrides)))
    place = given_path(cases, "cases")
    folder = given_path(out, "out") if out is not None else Path("runs") / f"batch_{_called(place)}"
    progress = progress or Silent()
    start = time.perf_counter()
    named = each_stage(stages)
    common: dict[str, Any] = {
        "out": str(folder.absolute()), "preset": anchored_preset(preset),
        "overrides": list(texts), "stages": list(named) if named else None, "keep": keep,
        "memory": _memory_each(memory, jobs, scheduler), "seconds": (minutes or 0) * 60,
        "threads": 0 if scheduler else max(1, usable_cores() // jobs),
        "verbose": progress.verbose,
    }  # fmt: skip
    plan = make_plan(
        place, folder, common["preset"], texts, named, retry, keep, progress.message
    )  # fmt: skip
    check_folder(folder, place, plan.cases, chosen=out is not None)
    wait = "Wait for it (its summary.html shows how far it is)"
    alone = only_one(folder.absolute(), "batch", FOLDERS, wait)
    with kept_for(share_for(folder, share)), alone as home:
        for name in FOLDERS:
            stage_folder(home, name)
        plan = plan.again()
        check_folder(folder, place, plan.cases, chosen=out is not None)
        session, version = uuid.uuid4().hex, library_version("dentalsplat")
        found = {"id": session, "version": version, "cases": str(place.resolve())}
        write_json(home / BATCH, found)
        common |= {"share": share_for(home), "session": session, "batch": session}
        work = _Work(plan, home, common, progress, f"Batch: {place.resolve().name}")
        work.run(scheduler, jobs)
    records = work.records()
    return {
        "folder": str(folder),
        "cases": records,
        "counts": dict(Counter(record["state"] for record in records)),
        "seconds": round(time.perf_counter() - start, 2),
    }


def exit_status(results: Mapping[str, Any]) -> int:
    """0: all cases are done; 1: a fault of ours or a killed case; 3: others have no scene."""
    counts = results["counts"]
    if any(counts.get(state) for state in ("fault", "killed", "stopped", "running", "waiting")):
        return 1
    return 3 if counts.get("refused") or counts.get("wrong") else 0


class _Work:
    """The cases of a batch on their way to the end."""

    def __init__(
        self, plan: Plan, home: Path, common: dict[str, Any], progress: Lines, title: str
    ) -> None:
        self._plan, self._home, self._common = plan, home, common
        self._progress, self._title = progress, title
        self._records = dict(plan.records)
        self._left = {case.id for case in plan.waiting}
        self._written = self._looked = 0.0
        self._seen: dict[str, int] = {}
        self._heard = {case.id: _size(self._log(case)) for case in plan.waiting}
        #: Cases that are given out, by the keys of their tasks; a task whose future nobody holds
        #: is cancelled.
        self._cases: dict[str, Case] = {}
        self._futures: dict[str, Any] = {}
        #: How many tasks there have been; each has a key of its own.
        self._given = 0

    def records(self) -> list[dict[str, Any]]:
        """All cases in their order."""
        return [self._records[case.id] for case in self._plan.cases]

    def run(self, scheduler: str | None, jobs: int) -> None:
        """Bring all to an end; the summary is written whatever happens."""
        total = len(self._plan.waiting)
        finished = sum(record["state"] == "done" for record in self._records.values())
        if finished:
            self._progress.message(f"{finished} of {len(self._records)} cases are done already")
        ended = [case.id for case in self._plan.cases if not case.settled]
        if failed := sum(self._records[case]["state"] in FAILED for case in ended):
            self._progress.message(
                f"{failed} of {len(self._records)} cases went wrong before and are not run again; "
                "--retry failed does that"
            )
        for record in self._records.values():
            if record["state"] in ("skipped", "duplicate", "wrong"):
                self._progress.message(f"{record['name']}: {record['state']}: {record['reason']}")
        self._summary()
        try:
            if total:
                with connected(scheduler, jobs) as client:
                    check_workers(client, self._home, self._common["batch"])
                    self._progress.start(total)
                    self._run(client, total, scheduler)
        finally:
            self._progress.stop()
            for case in self._left:
                if self._records[case]["state"] == "running":
                    self._records[case] = {**self._records[case], "state": "stopped"}
            self._summary()

    def _run(self, client: Any, total: int, scheduler: str | None) -> None:
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        waiting = deque(self._plan.waiting)
        try:
            lonely = 0.0
            while self._left:
                self._submit(client, waiting, ended)
                with contextlib.suppress(queue.Empty):
                    future = ended.get(timeout=TICK)
                    case = self._cases.pop(future.key)
                    del self._futures[future.key]
                    self._listen(case)
                    if future.status == "lost":
                        # its worker died with it, just when it had ended: its record still tells
                        waiting.appendleft(case)
                    else:
                        self._ended(case, future, total)
                    if time.monotonic() - self._looked < TICK:
                        continue  # all that have ended come first
                if client.status == "closed" and not self._futures:
                    raise _gone()
                self._look()
                self._looked = time.monotonic()
                counts = Counter(record["state"] for record in self._records.values())
                self._progress.state(counts, total - len(self._left), total)
                if time.monotonic() - self._written > SUMMARY:
                    self._summary()
                if scheduler and time.monotonic() - lonely > 60 and not slots(client):
                    lonely = time.monotonic()
                    self._progress.message(f"Waiting: the scheduler {scheduler} has no workers.")
        except BaseException:
            stop(self._common["session"])
            if scheduler and client.status == "running":
                with contextlib.suppress(Exception):
                    client.cancel(list(self._futures.values()))
                    client.run(stop, self._common["session"], on_error="ignore")
            raise

    def _submit(self, client: Any, waiting: deque[Case], ended: queue.SimpleQueue[Any]) -> None:
        """Give out as many cases as there are places for them.

        No more: the scheduler would share all of them out at once, and hold the death of a worker
        against every case in its queue; after some deaths it would give up cases never begun.
        """
        if not waiting or client.status != "running":
            return
        for _ in range(min(len(waiting), max(1, slots(client)) - len(self._futures))):
            case = waiting.popleft()
            job = {
                **self._common, "case": case.to_dict(), "settings": self._plan.settings[case.id],
                "again": case.id in self._plan.retried,
            }  # fmt: skip
            # a lost case is another task: the scheduler may still be making the first one anew
            self._given += 1
            key = f"{case.id}-{self._common['session']}-{self._given}"
            future = client.submit(run_case, job, key=key, pure=False, retries=0)
            self._cases[future.key], self._futures[future.key] = case, future
            future.add_done_callback(ended.put)

    def _ended(self, case: Case, future: Any, total: int) -> None:
        """Take what came of a case."""
        if future.status == "cancelled":
            raise _gone()
        if future.status == "error":
            record = self._broken(case, future.exception())
        else:
            record = future.result()
        if record["state"] in ("unseen", "full"):
            raise RequestError(record["reason"])
        self._records[case.id] = record
        self._left.discard(case.id)
        self._progress.case(record, total - len(self._left), total)

    def _broken(self, case: Case, error: BaseException) -> dict[str, Any]:
        """A record of a case whose task gave none."""
        from distributed.scheduler import KilledWorker

        settings = {"settings": self._plan.settings[case.id]}
        if isinstance(error, KilledWorker):
            why = (
                "The workers that ran it died, again and again, as a system does where memory runs "
                f"out. Look into logs/{case.id}.txt, and run with --retry failed."
            )
            record = new_record(case, "killed", why, **settings)
        elif why := closed_to_us(error, self._home):
            record = new_record(case, "wrong", why, **settings)
        else:
            why = f"A fault of ours on a worker: {type(error).__name__}: {error}"
            record = new_record(case, "fault", " ".join(why.split())[:600], **settings)
        remove(thumbnail_of(self._home, case.id))
        write_case(self._home, record)
        return record

    def _look(self) -> None:
        """Which cases have begun, from their records."""
        for case in self._plan.waiting:
            if case.id not in self._left:
                continue
            self._listen(case)
            with contextlib.suppress(OSError):
                stamp = (self._home / "records" / f"{case.id}.json").stat().st_mtime_ns
                if self._seen.get(case.id) == stamp:
                    continue
                self._seen[case.id] = stamp
                record = read_case(self._home, case.id)
                if record is not None and record["session"] == self._common["session"]:
                    self._records[case.id] = record

    def _log(self, case: Case) -> Path:
        return self._home / "logs" / f"{case.id}.txt"

    def _listen(self, case: Case) -> None:
        """Hand on the lines that a case has written since, where somebody wants to hear them."""
        if not self._progress.verbose:
            return
        new = b""
        with contextlib.suppress(OSError), self._log(case).open("rb") as log:
            log.seek(self._heard[case.id])
            new = log.read()
        whole = new[: new.rfind(b"\n") + 1]  # a line that is being written comes next time
        self._heard[case.id] += len(whole)
        for line in whole.decode(errors="replace").splitlines():
            self._progress.step(self._records[case.id], readable(line.strip()))

    def _summary(self) -> None:
        counts = Counter(record["state"] for record in self._records.values())
        when = time.strftime("%Y-%m-%d %H:%M")
        try:
            write_summary(
                self._home, self.records(), self._title, f"{by_state(counts)}; as of {when}."
            )
        except (OSError, RequestError) as error:  # a full disk: the cases say so as well
            self._progress.message(f"The summary could not be written: {error}")
        self._written = time.monotonic()


def _gone() -> RequestError:
    return RequestError(
        "The Dask scheduler is gone, or has cancelled the batch. Nothing that was computed is "
        "lost: start it again and run the same command again."
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _check(jobs: object, keep: object, memory: object, minutes: object, retry: object) -> None:
    """Refuse what only a program can give; the command line knows what each may be.

    Raises:
        RequestError: it names the argument.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise RequestError(
            f"jobs is how many cases run at a time, 1 at least; this is {shown(jobs)}."
        )
    if keep not in KEEPS:
        raise RequestError(f"keep is {' or '.join(KEEPS)}; this is {shown(keep)}.")
    for name, number in (("memory", memory), ("minutes", minutes)):
        if number is not None and not (isinstance(number, int | float) and 0 <= number < math.inf):
            raise RequestError(f"{name} is a number, 0 or more; this is {shown(number)}.")
    if not isinstance(retry, Iterable) or not all(isinstance(name, str) for name in retry):
        raise RequestError(f"retry is 'failed', or names of cases; this is {shown(retry)}.")


def _called(place: Path) -> str:
    """Name of a folder of cases, with all its dots, or of a list without its suffix."""
    return place.resolve().stem if place.is_file() else place.resolve().name


def _memory_each(gigabytes: float | None, jobs: int, scheduler: str | None) -> int | None:
    """Bytes for one case; 0: no limit; None: what a worker was given."""
    if gigabytes is not None:
        return math.ceil(gigabytes * 1e9)
    if scheduler is not None:
        return None
    import psutil

    return int(psutil.virtual_memory().total * 0.9 / jobs)
