"""The plan of a closed model: in which columns behind a seen surface there is material, and from
which layer on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: mm over which directions and heights are means, and borders even.
LOOKS_OVER, HEIGHTS_OVER, BORDERS_OVER = 3.0, 1.0, 1.0
#: A border is this many columns wide.
WIDE = 2.0


@dataclass(frozen=True)
class Plan:
    """Columns along y, away from the other jaw.

    Attributes:
        share: [X, Z] of each column that is the model's, 0..1.
        top: [X, Z] the layer that its material begins at; of no meaning where there is none.
    """

    share: Array
    top: Array


def plan_behind(
    places: Ints, normals: Array, shape: tuple[int, int, int], voxel: float, depth: float
) -> Plan:
    """The columns that a surface is in, and those behind it.

    Behind the edge of a crown material is as high as that edge, and falls off from there in a
    quarter of a circle. Edges are evened out along the row.

    Args:
        places: [N, 3] points of a grid that the surface passes.
        normals: [N, 3] of the surface there.
        shape: X, Y, Z of the grid.
        voxel: its distance of points, mm.
        depth: of the material, mm.
    """
    columns = places[:, 0], places[:, 2]
    size = shape[0], shape[2]
    tops = np.full(size, np.inf)
    np.minimum.at(tops, columns, places[:, 1].astype(np.float64))
    seen = np.isfinite(tops)
    look = np.zeros((2, *size))
    for part, axis in zip(look, (0, 2), strict=True):
        np.add.at(part, columns, normals[:, axis])
    look = np.stack([ndimage.gaussian_filter(part, LOOKS_OVER / voxel) for part in look])
    look /= np.maximum(np.linalg.norm(look, axis=0), 1e-12)
    top = tops.copy()
    highest = ndimage.minimum_filter(tops, 3)  # no gaps between the columns of a slanting surface
    here = np.indices(size)
    steps = max(1, int(depth / voxel))
    for step in range(1, steps + 1):
        ahead = np.rint(here + step * look).astype(np.int64)
        inside = ((ahead >= 0) & (ahead < np.array(size)[:, None, None])).all(0)
        there = np.where(inside, highest[tuple(ahead * inside)], np.inf)
        top = np.minimum(top, there + steps * (1 - np.sqrt(1 - (step / steps) ** 2)))
    behind = np.isfinite(top) & ~seen
    height = _mean(top, behind, HEIGHTS_OVER / voxel)
    share = ndimage.gaussian_filter((behind | seen).astype(float), BORDERS_OVER / voxel)
    slope = np.sqrt(2 * np.pi) * BORDERS_OVER / voxel / WIDE
    share = np.where(seen, 1.0, np.clip(slope * (share - 0.5) + 0.5, 0, 1))
    return Plan(share, np.where(seen, top, height))


def _mean(values: Array, known: npt.NDArray[np.bool_], sigma: float) -> Array:
    """Gaussian means [X, Z] of the values that are known."""
    weights = ndimage.gaussian_filter(known.astype(float), sigma)
    total = ndimage.gaussian_filter(np.where(known, values, 0), sigma)
    return np.asarray(total / np.maximum(weights, 1e-12))
