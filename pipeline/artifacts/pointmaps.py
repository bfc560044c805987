"""`pointmaps`: for each image pair, the 3D point of every pixel, in the frame of the first view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class PointmapPair:
    """What a pointmap model (DUSt3R, section 3) says of one image pair.

    Attributes:
        name_i, name_j: the views.
        points_i: [H_i, W_i, 3] float32, points of view i in the camera frame of i.
        points_j_in_i: [H_j, W_j, 3] float32, points of view j in the camera frame of i.
        confidence_i, confidence_j: [H, W] float32, raw, >= 1; exactly 1 means "nothing known", and
            the points there may be anything finite.
    """

    name_i: str
    name_j: str
    points_i: Array
    points_j_in_i: Array
    confidence_i: Array
    confidence_j: Array


class Pointmaps(Artifact):
    """A set of pairs, each read from disk when asked for: twelve views are a lot of memory."""

    kind: ClassVar[str] = "pointmaps"

    def __init__(self, pairs: list[PointmapPair] | None = None, folder: Path | None = None) -> None:
        if (pairs is None) == (folder is None):
            raise ValueError("give either the pairs or the folder to read them from")
        self._pairs = pairs
        self._files = sorted(folder.glob("*.npz")) if folder else []

    def __len__(self) -> int:
        return len(self._files) if self._pairs is None else len(self._pairs)

    def __iter__(self) -> Iterator[PointmapPair]:
        if self._pairs is not None:
            yield from self._pairs
        for path in self._files:
            yield read_pair(path)

    def save(self, folder: Path) -> None:
        for pair in self:
            write_pair(folder / f"{pair.name_i}_{pair.name_j}.npz", pair)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls(folder=folder)


def write_pair(path: Path, pair: PointmapPair) -> None:
    """Write one pair as `.npz`: points_i, points_j_in_i, confidence_i, confidence_j, names."""
    np.savez(
        path,
        points_i=pair.points_i, points_j_in_i=pair.points_j_in_i,
        confidence_i=pair.confidence_i, confidence_j=pair.confidence_j,
        names=np.array([pair.name_i, pair.name_j]),
    )  # fmt: skip


def read_pair(path: Path) -> PointmapPair:
    """Read one pair; without `names`, the file name ``<i>_<j>.npz`` gives them."""
    with np.load(path, allow_pickle=False) as data:
        if "names" in data:
            name_i, name_j = (str(name) for name in data["names"])
        else:
            name_i, name_j = path.stem.split("_", 1)
        return PointmapPair(
            name_i, name_j,
            *(np.ascontiguousarray(data[key], np.float32)
              for key in ("points_i", "points_j_in_i", "confidence_i", "confidence_j")),
        )  # fmt: skip
