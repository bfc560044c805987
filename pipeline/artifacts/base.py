"""What an artifact is: arrays in memory, files in standard formats on disk."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar, Self

from pipeline.errors import RequestError, nearest

#: kind -> where its class lives. Imported on first use, so that listing the kinds costs nothing.
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


def artifact_class(kind: str) -> type[Artifact]:
    """Return the class of an artifact kind.

    Raises:
        RequestError: `kind` is not a known kind.
    """
    try:
        module, name = KINDS[kind].split(":")
    except KeyError:
        raise RequestError(
            f"Unknown artifact kind '{kind}'; the kinds are {', '.join(KINDS)}."
            f"{nearest(kind, KINDS)}"
        ) from None
    loaded: type[Artifact] = getattr(importlib.import_module(module), name)
    return loaded
