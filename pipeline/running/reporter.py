"""Who hears what happens in a run."""

from __future__ import annotations

from typing import Any

from pipeline.running.outcomes import StageOutcome

Figure = float | int | str


class Reporter:
    """Hears what happens in a run. This one says nothing; the others show it."""

    def start(self, stages: list[str]) -> None:
        """A run of these stages begins."""

    def foreseen(self, stages: list[StageOutcome]) -> None:
        """What is going to be done, before it starts (as `Runner.dry_run` tells it)."""

    def stage_started(self, stage: str, reasons: list[str], resumed: bool) -> None:
        """A stage begins to compute."""

    def progress(self, stage: str, step: str, done: int, total: int, **figures: Figure) -> None:
        """A stage has come to `done` of `total` in `step`."""

    def stage_finished(self, stage: str, cached: bool, figures: dict[str, Any]) -> None:
        """A stage's result is in the store."""

    def message(self, text: str) -> None:
        """Something that the user should know."""

    def stop(self) -> None:
        """The run is over, well or not."""
