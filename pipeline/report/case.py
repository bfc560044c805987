"""What a report reads: the stages of a workspace's last request, and their results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.artifacts import artifact_class
from pipeline.config import Config, load_config
from pipeline.errors import PipelineError, RequestError
from pipeline.files import read_json
from pipeline.store import Result, Store
from pipeline.workspace import StageStatus, status


@dataclass(frozen=True)
class StageRecord:
    """One stage of the request.

    Attributes:
        name: of the stage.
        state: as `pipeline.workspace.StageStatus` has it.
        reasons: why it is stale, or why it ran last.
        failure: why its last try failed, or None.
        result: what the workspace holds of it and what belongs to this request's chain, or None.
    """

    name: str
    state: str
    reasons: tuple[str, ...] = ()
    failure: str | None = None
    result: Result | None = None

    @property
    def manifest(self) -> dict[str, Any]:
        return self.result.manifest if self.result else {}

    @property
    def summary(self) -> dict[str, Any]:
        """Figures that the stage reported."""
        return dict(self.manifest.get("summary", {}))

    @property
    def warnings(self) -> list[str]:
        return list(self.manifest.get("warnings", []))

    @property
    def fresh(self) -> bool:
        """Its result is what the request asks for."""
        return self.result is not None and self.state == "cached"


@dataclass
class Case:
    """A workspace as its last request left it.

    Attributes:
        workspace: the folder.
        request: what `request.json` says.
        stages: in the order of the run.
        config: the resolved config, or None where it can't be resolved any more.
        notes: what could not be found out, in words.
    """

    workspace: Path
    request: dict[str, Any]
    stages: tuple[StageRecord, ...]
    config: Config | None = None
    notes: list[str] = field(default_factory=list)
    _loaded: dict[tuple[str, str], Any] = field(default_factory=dict, repr=False)

    @cached_property
    def by_name(self) -> dict[str, StageRecord]:
        return {stage.name: stage for stage in self.stages}

    @property
    def failed(self) -> StageRecord | None:
        """The stage that the run ended in, if it failed."""
        return next((stage for stage in self.stages if stage.failure), None)

    def folder(self, stage: str, kind: str) -> Path | None:
        """Where a stage's artifact is, or None if there is none."""
        record = self.by_name.get(stage)
        if record is None or record.result is None or kind not in record.result.contents:
            return None
        return record.result.folder / kind

    def load(self, stage: str, kind: str) -> Any:
        """A stage's artifact, or None if there is none. Read once."""
        folder = self.folder(stage, kind)
        if folder is None:
            return None
        if (stage, kind) not in self._loaded:
            self._loaded[stage, kind] = artifact_class(kind).load(folder)
        return self._loaded[stage, kind]

    def providers(self, kind: str) -> list[str]:
        """The stages that gave an artifact kind, in order."""
        return [stage.name for stage in self.stages if self.folder(stage.name, kind)]

    def latest(self, kind: str) -> Any:
        """The artifact of a kind as the last stage that provides it left it, or None."""
        names = self.providers(kind)
        return self.load(names[-1], kind) if names else None

    def evidence(self, kind: str) -> Any:
        """The artifact of a kind that the failed stage kept although it isn't safe, or None."""
        return Store(self.workspace).evidence(self.failed.name, kind) if self.failed else None

    def warnings(self) -> Iterator[tuple[str, str]]:
        """(stage, warning) of all results."""
        for stage in self.stages:
            for text in stage.warnings:
                yield stage.name, text

    def figures(self) -> dict[str, Any]:
        """All stages' summary figures; of equal names the last stage's."""
        found: dict[str, Any] = {}
        for stage in self.stages:
            found |= stage.summary
        return found


def read_case(workspace: Path) -> Case:
    """Read a workspace.

    Raises:
        RequestError: no run has been started there.
    """
    request = read_json(workspace / "request.json")
    if not isinstance(request, dict):
        raise RequestError(
            f"{workspace} is not a workspace: no run has been started there. Give the folder that "
            "'pipeline run' named, with -w."
        )
    notes: list[str] = []
    store = Store(workspace)
    try:
        config: Config | None = load_config(request.get("preset"), request.get("overrides", []))
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
        order = list(config.run.stages) if config else []
        names.sort(key=lambda name: (order.index(name) if name in order else len(order), name))
        found = [StageStatus(name, "unknown") for name in names]
    readers = _readers(found, store)
    records = []
    broken = False
    for entry in [*readers, *found]:
        failure = entry.failure or _failure(store, entry.name)
        broken = broken or bool(failure)
        records.append(
            StageRecord(
                entry.name, "failed" if failure else entry.state, tuple(entry.reasons), failure,
                # What lies there of stages after a failed one belongs to an earlier run.
                None if broken else _result(store, entry),
            )
        )  # fmt: skip
    return Case(workspace, request, tuple(records), config, notes)


def _failure(store: Store, name: str) -> str | None:
    failure = store.failure(name)
    return str(failure["message"]) if failure else None


def _result(store: Store, entry: StageStatus) -> Result | None:
    if entry.key and (result := store.find(entry.name, entry.key)):
        return result
    return store.current(entry.name)


def _readers(found: list[StageStatus], store: Store) -> list[StageStatus]:
    """Stages whose results were taken as they were (`status` leaves them out)."""
    named = {entry.name for entry in found}
    needed = {
        source["stage"]
        for entry in found
        if (result := _result(store, entry)) is not None
        for source in result.manifest["inputs"].values()
    } - named
    return [
        StageStatus(name, "cached", ["taken as it was"])
        for name in sorted(needed) if store.current(name) is not None
    ]  # fmt: skip


def read_metrics(case: Case) -> dict[str, Any]:
    """The figures of `metrics.json`; empty where there are none."""
    folder = next((case.folder(name, "metrics") for name in case.providers("metrics")[::-1]), None)
    path = folder / "metrics.json" if folder else None
    if path is None or not path.is_file():
        return {}
    figures = json.loads(path.read_text())
    return figures if isinstance(figures, dict) else {}


def held_out_blocks(metrics: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Protocol of the test poses -> its figures; what else stands there is left out."""
    found = metrics.get("held_out", {})
    return {
        name: found[name] for name in ("registered", "refined")
        if isinstance(found.get(name), dict) and found[name].get("views")
    }  # fmt: skip
