"""`metrics`: the figures of an evaluation, as `metrics.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

from pipeline.artifacts.base import Artifact

#: How the poses of held-out views came about, in the order in which they are told.
PROTOCOLS = ("registered", "refined")


@dataclass(frozen=True)
class Scores:
    """The figures of some views: psnr, ssim, lpips (None without weights), coverage, and the like.

    Attributes:
        views: view name -> its figures.
        mean: over the views.
        worst: figure -> {"view": name, "value": figure}.
        protocol: how it was scored, in a sentence.
    """

    views: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    mean: Mapping[str, Any] = field(default_factory=dict)
    worst: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    protocol: str = ""

    @classmethod
    def of(cls, figures: Mapping[str, Any]) -> Self:
        """Those that stand in a part of `metrics.json`; what else stands there is left out."""
        return cls(
            figures.get("views", {}), figures.get("mean", {}), figures.get("worst", {}),
            figures.get("protocol", ""),
        )  # fmt: skip


@dataclass(frozen=True)
class Metrics(Artifact):
    """Figures by name: nested dicts, lists, numbers, strings. No timings, so that bytes repeat."""

    kind: ClassVar[str] = "metrics"
    #: The file of the figures; pictures may lie beside it.
    FILE: ClassVar[str] = "metrics.json"
    figures: dict[str, Any]

    def save(self, folder: Path) -> None:
        text = json.dumps(self.figures, indent=1, sort_keys=True, allow_nan=False)
        (folder / self.FILE).write_text(text + "\n")

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(json.loads((folder / cls.FILE).read_text()))

    @property
    def input(self) -> Scores:
        """The views that the scene was made from."""
        return Scores.of(self.figures)

    @property
    def held_out(self) -> dict[str, Scores]:
        """Protocol of the test poses -> the views that the reconstruction never saw."""
        found = self.part("held_out")
        return {
            name: Scores.of(found[name]) for name in PROTOCOLS
            if isinstance(found.get(name), dict)
        }  # fmt: skip

    @property
    def pictured(self) -> str | None:
        """The protocol that the pictures of held-out views were rendered with."""
        said = self.part("held_out").get("pictures")
        return said if isinstance(said, str) else next(iter(self.held_out), None)

    def part(self, name: str) -> dict[str, Any]:
        """A group of figures, such as ``poses`` or ``geometry``; empty where not measured."""
        found = self.figures.get(name)
        return found if isinstance(found, dict) else {}
