"""What a run did."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.store import Result


@dataclass
class StageOutcome:
    """What a run did about one stage.

    Attributes:
        action: ``ran``, ``resumed`` (ran, from a checkpoint) or ``cached``; in a dry run ``would
            run`` or ``unknown`` (depends on what an earlier stage will give).
        reasons: why it ran.
        figures: wall_seconds, cpu_seconds, peak_memory_mb of when it was computed, and `summary`;
            before it runs, wall_seconds of its last time alone, if there was one.
    """

    name: str
    action: str
    reasons: list[str] = field(default_factory=list)
    key: str | None = None
    folder: Path | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass
class RunSummary:
    """What a run did, and where its outputs lie."""

    workspace: Path
    stages: list[StageOutcome] = field(default_factory=list)
    results: Path | None = None
    report: Path | None = None
    check: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "workspace": str(self.workspace),
            "results": str(self.results) if self.results else None,
            "report": str(self.report) if self.report else None,
            "check": str(self.check) if self.check else None,
            "stages": [
                {**vars(s), "folder": str(s.folder) if s.folder else None} for s in self.stages
            ],
        }


def figures_of(result: Result) -> dict[str, Any]:
    """The figures of an outcome, as the result's manifest has them."""
    names = ("wall_seconds", "cpu_seconds", "peak_memory_mb", "summary")
    return {name: result.manifest[name] for name in names}
