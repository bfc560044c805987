"""`points`: a coloured point cloud with normals, confidence and scale, as one `.ply`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement

from pipeline.artifacts.base import Artifact
from pipeline.untrusted.scenes.ply import read_cloud

Array = npt.NDArray[np.float32]

#: What the file has of each point.
PROPERTIES = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "confidence", "scale")


@dataclass(frozen=True)
class Points(Artifact):
    """A dense cloud in world coordinates.

    Attributes:
        positions: [N, 3] float32.
        colors: [N, 3] float32 sRGB in 0..1 (8 bits at rest).
        normals: [N, 3] float32 unit vectors towards the cameras that saw the point; 0 if unknown.
        confidence: [N] float32, raw, >= 1, larger is better (as pointmap models give it): filled
            in, guessed or measured (`pipeline.artifacts.confidence`).
        scale: [N] float32 local spacing in world units (sigma of 3DGS's initialisation); 0 if
            unknown.
    """

    kind: ClassVar[str] = "points"
    positions: Array
    colors: Array
    normals: Array
    confidence: Array
    scale: Array

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Points:
        """The points that a boolean mask [N] or an index array selects."""
        return Points(
            self.positions[index], self.colors[index], self.normals[index],
            self.confidence[index], self.scale[index],
        )  # fmt: skip

    def save(self, folder: Path) -> None:
        write_points_ply(folder / "points.ply", self)

    @classmethod
    def load(cls, folder: Path) -> Self:
        vertex = read_cloud(folder / "points.ply", PROPERTIES)

        def stack(*names: str) -> Array:
            return np.stack([vertex[name] for name in names], -1).astype(np.float32)

        return cls(
            positions=stack("x", "y", "z"),
            colors=stack("red", "green", "blue") / np.float32(255),
            normals=stack("nx", "ny", "nz"),
            confidence=np.array(vertex["confidence"], np.float32),
            scale=np.array(vertex["scale"], np.float32),
        )


def write_points_ply(path: Path, points: Points) -> None:
    """Write binary little-endian PLY: x y z nx ny nz red green blue confidence scale."""
    names = PROPERTIES[:6]
    fields = [(n, "<f4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(points), dtype=[*fields, ("confidence", "<f4"), ("scale", "<f4")])
    for axis, (position, normal) in enumerate(zip(names[:3], names[3:], strict=True)):
        rows[position] = points.positions[:, axis]
        rows[normal] = points.normals[:, axis]
    eight_bit = np.clip(np.rint(points.colors * 255), 0, 255).astype(np.uint8)
    for axis, channel in enumerate(("red", "green", "blue")):
        rows[channel] = eight_bit[:, axis]
    rows["confidence"] = points.confidence
    rows["scale"] = points.scale
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
