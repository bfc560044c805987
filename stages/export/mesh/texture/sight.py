"""Which cameras see which part of a mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from stages.export.mesh.surface import Mesh
from stages.export.pictures.preview import draw

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: A vertex is seen if it lies no further behind what is drawn there than this share of its depth.
BEHIND = 0.004


@dataclass(frozen=True)
class Sight:
    """A mesh as one camera sees it.

    Attributes:
        pixels: [V, 2] where its vertices are in the photograph; of those outside, anything.
        seen: [V] whether the camera sees them, and the photograph may be used there.
        facing: [F] pixels that a face covers for each unit of its area; 0: it is turned away, or
            a corner is not seen.
    """

    pixels: Array
    seen: Bools
    facing: Array


def sights(mesh: Mesh, cameras: Sequence[Camera], masks: Mapping[str, Bools]) -> list[Sight]:
    """The mesh as each camera sees it.

    Args:
        mesh: in the world of the cameras.
        cameras: K of them.
        masks: by camera name, [H, W], True: usable.
    """
    corners = mesh.vertices[mesh.faces]
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(*edges), axis=1)
    return [_sight(mesh, area, camera, masks[camera.name]) for camera in cameras]


def _sight(mesh: Mesh, area: Array, camera: Camera, mask: Bools) -> Sight:
    pixels, depths = camera.project(mesh.vertices)
    nearest = np.zeros((camera.height, camera.width), np.float32)
    draw(pixels, depths, depths, mesh.faces, nearest, np.zeros_like(nearest))
    inside = camera.shows(pixels, depths)
    column, row = np.where(inside[:, None], pixels, 0).astype(np.int64).T
    seen = inside & mask[row, column] & (depths * nearest[row, column] < 1 + BEHIND)
    a, b, c = (pixels[mesh.faces[:, k]] for k in range(3))
    across, along = b - a, c - a
    # counter-clockwise from outside is clockwise on a screen whose y leads down
    covered = across[:, 1] * along[:, 0] - across[:, 0] * along[:, 1]
    whole = seen[mesh.faces].all(1) & (covered > 0)
    return Sight(pixels, seen, np.where(whole, covered / np.maximum(area, 1e-30), 0.0))
