"""`metrics`: the figures of an evaluation, as `metrics.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from pipeline.artifacts.base import Artifact


@dataclass(frozen=True)
class Metrics(Artifact):
    """Figures by name: nested dicts, lists, numbers, strings. No timings, so that bytes repeat."""

    kind: ClassVar[str] = "metrics"
    figures: dict[str, Any]

    def save(self, folder: Path) -> None:
        text = json.dumps(self.figures, indent=1, sort_keys=True, allow_nan=False)
        (folder / "metrics.json").write_text(text + "\n")

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(json.loads((folder / "metrics.json").read_text()))
