"""The exports of a workspace, if they are what its last run came to."""

from __future__ import annotations

import re
from pathlib import Path
from shlex import quote

from pipeline.errors import RequestError
from pipeline.pages.case import Case, StageRecord
from pipeline.store import Store
from pipeline.studies.report.reading import renewed

#: The stage that makes them, and what kind of artifact they are.
STAGE, KIND = "export", "exports"


def exports_of(case: Case) -> Path:
    """The folder of the exports that the last request of a workspace leads to.

    Those of an earlier version of the program will do; those of other photographs, of other
    settings or of a fit that is no longer in use will not.

    Raises:
        RequestError: the last run failed before its exports or did not come to its end, or they
            were made from something else than what is in use.
    """
    record = case.by_name.get(STAGE)
    if record is not None and record.fresh and (folder := case.folder(STAGE, KIND)):
        return folder
    later = _later(case)
    if case.failed is not None and case.failed.name not in later:
        raise RequestError(
            f"{case.workspace}: the last run ended in {case.failed.name}, and exports that are "
            f"there belong to a run before. What says why: "
            f"pipeline status -w {quote(str(case.workspace))}"
        )
    for entry in case.stages:
        if entry.name not in later and entry.state in ("stale", "missing") and not _aged(entry):
            why = f" ({'; '.join(entry.reasons)})" if entry.reasons else ""
            raise RequestError(_unfinished(case.workspace, f"'{entry.name}' has yet to run{why}"))
    store = Store(case.workspace)
    result = store.current(STAGE)
    if result is None:
        return case.workspace / "results"
    if other := renewed(store, result):
        raise RequestError(_unfinished(case.workspace, f"'{other}' has another result by now"))
    return result.folder / KIND


def _unfinished(workspace: Path, why: str) -> str:
    return (
        f"{workspace} has no exports of what it was last asked for: {why}. Run the pipeline to its "
        f"end first: pipeline run -w {quote(str(workspace))}"
    )


def _later(case: Case) -> tuple[str, ...]:
    """The stages that come after the exports and change nothing about them."""
    order = [record.name for record in case.stages]
    if STAGE not in order:
        order = list(getattr(case.run_settings, "stages", ()))
    return tuple(order[order.index(STAGE) + 1 :]) if STAGE in order else ()


def _aged(record: StageRecord) -> bool:
    """Would a stage run anew only because the program or a library is another one by now?"""
    mine = re.escape(record.name)
    newer = re.compile(rf"library |{mine} (?:version|backend) |{mine}\.\S+ \(absent\) ")
    return bool(record.reasons) and all(map(newer.match, record.reasons))
