"""The run that a page tells of: the stages of a workspace's last request, and their results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pipeline.artifacts import artifact_class
from pipeline.store import Result
from pipeline.store.failures import Failures


@dataclass(frozen=True)
class StageRecord:
    """One stage of the request.

    Attributes:
        name: of the stage.
        state: as `pipeline.status` tells it.
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


def unchanged(value: Any) -> Any:
    """Hides nothing."""
    return value


@dataclass
class Case:
    """A workspace as its last request left it.

    Attributes:
        workspace: the folder.
        request: what `request.json` says.
        stages: in the order of the run.
        settings: the settings of each stage, as the request resolves today; empty where they can't
            be resolved any more. Those of the whole run stand in `run_settings`.
        notes: what could not be found out, in words.
        hide: takes names out of a text, or out of all texts of a JSON-like value, of a case made
            `anonymous`; of another it changes nothing.
    """

    workspace: Path
    request: dict[str, Any]
    stages: tuple[StageRecord, ...]
    settings: Mapping[str, BaseModel] = field(default_factory=dict)
    run_settings: BaseModel | None = None
    notes: list[str] = field(default_factory=list)
    _loaded: dict[tuple[str, str], Any] = field(default_factory=dict, repr=False)
    hide: Callable[[Any], Any] = field(default=unchanged, repr=False)

    @property
    def nameless(self) -> bool:
        """It was made `anonymous`: the page is passed on without what lies beside it."""
        return self.hide is not unchanged

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

    @cached_property
    def labels(self) -> dict[str, str]:
        """View name -> ``000 · frontal.jpg``."""
        found = {}
        for kind in ("views", "held_out"):
            artifact = self.latest(kind)
            for view in artifact.views if artifact else ():
                found[view.name] = (
                    f"{view.name} · {view.source_name}" if view.source_name else view.name
                )
        return found

    def evidence(self, kind: str) -> Any:
        """The artifact of a kind that the failed stage kept although it isn't safe, or None."""
        return Failures(self.workspace).evidence(self.failed.name, kind) if self.failed else None

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


def title_of(stem: str, labels: Mapping[str, str]) -> str:
    """The name of a picture with the names of the views in it made readable."""
    words = [labels.get(word, word) for word in stem.split("_")]
    return " ".join(words[:2]) + "".join(f" — {word}" for word in words[2:])
