"""Read a workspace: its last request, the state of each stage, and what they left."""

from __future__ import annotations

from pathlib import Path

from pipeline.config import Config, load_config
from pipeline.errors import PipelineError
from pipeline.pages.case import Case, StageRecord
from pipeline.store import Result, Store
from pipeline.workspace import StageStatus, installed_here, read_request, status


def read_case(workspace: Path) -> Case:
    """Read a workspace.

    Raises:
        RequestError: no run has been started there.
    """
    request = read_request(workspace)
    notes: list[str] = []
    store = Store(workspace)
    for pointer in sorted(workspace.glob("*/current.json")):
        store.current(pointer.parent.name)
    notes += store.said
    try:
        settings, _ = installed_here(request["overrides"])
        config: Config | None = load_config(request["preset"], settings)
    except PipelineError as error:
        config = None
        notes.append(f"The settings of the run can't be resolved any more: {error}")
    try:
        found = status(workspace=workspace)
    except PipelineError as error:
        notes.append(f"Whether results are stale can't be told: {error}")
        names = sorted(
            {
                path.parent.name
                for left in ("current.json", "failure.json")
                for path in workspace.glob(f"*/{left}") if path.is_file()
            }
        )  # fmt: skip
        names.sort(key=lambda name: _place(name, config))
        found = [StageStatus(name, "unknown") for name in names]
    records = []
    broken = False
    for entry in _with_taken(found, store, config):
        failure = entry.failure or _failure(store, entry.name)
        broken = broken or bool(failure)
        records.append(
            StageRecord(
                entry.name, "failed" if failure else entry.state, tuple(entry.reasons), failure,
                # What lies there of stages after a failed one belongs to an earlier run.
                None if broken else _result(store, entry),
            )
        )  # fmt: skip
    return Case(
        workspace, request, tuple(records), config.sections if config else {},
        config.run if config else None, notes,
    )  # fmt: skip


def _failure(store: Store, name: str) -> str | None:
    failure = store.failures.of(name)
    return str(failure["message"]) if failure else None


def _result(store: Store, entry: StageStatus) -> Result | None:
    if entry.key and (result := store.find(entry.name, entry.key)):
        return result
    return store.current(entry.name)


def _place(name: str, config: Config | None) -> tuple[int, str]:
    """Where a stage stands in a whole run."""
    order = config.run.stages if config else ()
    return (order.index(name) if name in order else len(order), name)


def _with_taken(found: list[StageStatus], store: Store, config: Config | None) -> list[StageStatus]:
    """Add the stages whose results were taken as they were (`status` leaves them out)."""
    named = {entry.name for entry in found}
    needed = {
        source["stage"]
        for entry in found
        if (result := _result(store, entry)) is not None
        for source in result.manifest["inputs"].values()
    } - named
    every = list(found)
    for name in sorted(needed, key=lambda name: _place(name, config)):
        if store.current(name) is not None:
            later = (
                k for k, e in enumerate(every) if _place(e.name, config) > _place(name, config)
            )
            at = next(later, len(every))
            every.insert(at, StageStatus(name, "cached", ["taken as it was"]))
    return every


def renewed(store: Store, result: Result) -> str | None:
    """The stage whose result in use is not the one that a result, or one before it, came from."""
    for kind, source in result.manifest["inputs"].items():
        used = store.current(source["stage"])
        if used is None or used.contents.get(kind) != source["content"]:
            return str(source["stage"])
        if other := renewed(store, used):
            return other
    return None
