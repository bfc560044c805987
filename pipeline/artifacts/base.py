"""What an artifact is: arrays in memory, files in standard formats on disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar, Self

from pipeline.errors import RequestError, nearest
from pipeline.plugins import check_name, load, registered

#: Entry points of this group add kinds.
GROUP = "dentalsplat.artifacts"
#: What lies beside the folders of a result's kinds.
TAKEN = ("scratch",)

#: The kinds of this project: where each class lives. Imported on first use, so that listing the
#: kinds costs nothing.
KINDS: dict[str, str] = {
    "views": "pipeline.artifacts.views:Views",
    "held_out": "pipeline.artifacts.views:HeldOut",
    "pointmaps": "pipeline.artifacts.pointmaps:Pointmaps",
    "cameras": "pipeline.artifacts.cameras:Cameras",
    "points": "pipeline.artifacts.points:Points",
    "flow": "pipeline.artifacts.flow:Flow",
    "gaussians": "pipeline.artifacts.gaussians:Gaussians",
    "exports": "pipeline.artifacts.exports:Exports",
    "metrics": "pipeline.artifacts.metrics:Metrics",
    "pictures": "pipeline.artifacts.pictures:Pictures",
    "teeth": "pipeline.artifacts.teeth:Teeth",
}


class Artifact(ABC):
    """One kind of data that stages hand to each other.

    `save` writes deterministic bytes: the same arrays give the same files. `load` gives back what
    `save` was given, up to the precision that the format states.
    """

    kind: ClassVar[str]

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write the files of this artifact into `folder`, which exists and is empty."""

    @classmethod
    @abstractmethod
    def load(cls, folder: Path) -> Self:
        """Read the artifact back from `folder`."""


def kinds() -> dict[str, Sequence[EntryPoint]]:
    """Kind -> where it is registered: those of this project, and entry points of `GROUP`."""
    found: dict[str, Sequence[EntryPoint]] = {
        kind: [EntryPoint(kind, where, GROUP)] for kind, where in KINDS.items()
    }
    for kind, entries in registered(GROUP).items():
        known = found.get(kind, ())
        values = [entry.value for entry in known]
        found[kind] = [*known, *(entry for entry in entries if entry.value not in values)]
    return found


def artifact_class(kind: str) -> type[Artifact]:
    """Return the class of an artifact kind.

    Raises:
        RequestError: nobody registers the kind, two do, or its class can't be used.
    """
    known = kinds()
    if kind not in known:
        raise RequestError(
            f"Unknown artifact kind '{kind}'; the kinds are {', '.join(known)}."
            f"{nearest(kind, known)}"
        )
    found: type[Artifact]
    found, where = load(f"kind of artifact '{kind}'", known[kind], Artifact)
    check_name(where, "kind", getattr(found, "kind", None), kind, TAKEN)
    return found
