"""What a stage is given when it runs for the store."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pipeline.config import Config
from pipeline.errors import StageError
from pipeline.planning import PlannedStage
from pipeline.process import signals
from pipeline.running.reporter import Reporter
from pipeline.stage import StageContext, get_stage
from pipeline.store import Store
from pipeline.untrusted.names import readable


class RunContext(StageContext):
    """The context of a stage that runs for the store."""

    def __init__(
        self, planned: PlannedStage, config: Config, store: Store, folder: Path, reporter: Reporter
    ) -> None:
        self.config = config.sections[planned.name]
        self.seed = config.run.seed
        self.threads = config.threads
        self.scratch = folder / "scratch"
        self.sources = planned.sources
        self.warnings = list(planned.notes)  # these have been said
        self.figures: dict[str, Any] = {}
        self.outputs: list[str] = []
        self._planned = planned
        self._store = store
        self._folder = folder
        self._reporter = reporter

    def has(self, kind: str) -> bool:
        return kind in self._planned.inputs

    def load(self, kind: str) -> Any:
        entry = self._planned.inputs.get(kind)
        if entry is None or entry.result is None:
            raise StageError(
                f"The stage '{self._planned.name}' asks for {kind}, which it was not given. "
                "Name it in `requires`, or in `optional` and ask `has` first."
            )
        return self._store.load(entry.result, kind)

    def output(self, kind: str) -> Path:
        stage = get_stage(self._planned.name)
        if kind not in (*stage.provides, *stage.may_provide):
            raise StageError(
                f"The stage '{stage.name}' writes {kind} without saying so. Name it in `provides` "
                "or `may_provide`."
            )
        path = self._folder / kind
        path.mkdir(exist_ok=True)
        if kind not in self.outputs:
            self.outputs.append(kind)
        return path

    def progress(self, step: str, done: int, total: int, **figures: float | int | str) -> None:
        signals.check()
        self._reporter.progress(self._planned.name, step, done, total, **figures)

    def warn(self, message: str) -> None:
        message = readable(message)
        self.warnings.append(message)
        self._reporter.message(f"{self._planned.name}: {message}")

    def summarize(self, **figures: float | int | str) -> None:
        for name, value in figures.items():  # a sum of an array is numpy's, and no JSON
            value = value.item() if hasattr(value, "item") else value
            finite = not isinstance(value, float) or math.isfinite(value)
            self.figures[name] = value if finite else str(value)  # which no JSON has
