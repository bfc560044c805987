"""`flow`: optical flow between neighbouring views in both directions, with consistency masks."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.base import Artifact
from pipeline.artifacts.views import read_png, write_png


@dataclass(frozen=True)
class FlowPair:
    """Flow between two views.

    Attributes:
        name_i, name_j: the views.
        forward: [H_i, W_i, 2] float32; pixel x of view i is seen at x + forward[x] in view j.
        backward: [H_j, W_j, 2] float32, likewise from j to i.
        mask_forward, mask_backward: bool, where the flow can be trusted.
    """

    name_i: str
    name_j: str
    forward: npt.NDArray[np.float32]
    backward: npt.NDArray[np.float32]
    mask_forward: npt.NDArray[np.bool_]
    mask_backward: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Flow(Artifact):
    """Flow of all chosen pairs, as Middlebury `.flo` files and mask `.png`s."""

    kind: ClassVar[str] = "flow"
    pairs: tuple[FlowPair, ...]

    def __len__(self) -> int:
        return len(self.pairs)

    def save(self, folder: Path) -> None:
        for pair in self.pairs:
            stem = f"{pair.name_i}_{pair.name_j}"
            for way in ("forward", "backward"):
                field = np.ascontiguousarray(getattr(pair, way), np.float32)
                write_flo(folder / f"{stem}_{way}.flo", field)
                mask = np.where(getattr(pair, f"mask_{way}"), np.uint8(255), np.uint8(0))
                write_png(folder / f"{stem}_{way}_mask.png", mask)

    @classmethod
    def load(cls, folder: Path) -> Self:
        pairs = []
        for path in sorted(folder.glob("*_forward.flo")):
            stem = path.name.removesuffix("_forward.flo")
            name_i, name_j = stem.split("_", 1)
            forward, backward = (
                read_flo(folder / f"{stem}_{way}.flo") for way in ("forward", "backward")
            )
            mask_forward, mask_backward = (
                read_png(folder / f"{stem}_{way}_mask.png") > 127 for way in ("forward", "backward")
            )
            pairs.append(FlowPair(name_i, name_j, forward, backward, mask_forward, mask_backward))
        return cls(tuple(pairs))


def write_flo(path: Path, field: npt.NDArray[np.float32]) -> None:
    """Write a flow [H, W, 2] as Middlebury's ``.flo``; OpenCV crashes on names that are no text."""
    height, width = field.shape[:2]
    path.write_bytes(_FLO + struct.pack("<ii", width, height) + field.astype("<f4").tobytes())


def read_flo(path: Path) -> npt.NDArray[np.float32]:
    """Read a flow [H, W, 2] as `write_flo` writes it."""
    data = path.read_bytes()
    width, height = struct.unpack_from("<ii", data, 4)
    if data[:4] != _FLO or len(data) != 12 + 8 * width * height:
        raise ValueError(f"{path} is not a readable .flo file")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)


_FLO = struct.pack("<f", 202021.25)
