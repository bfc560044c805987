"""Voxel downsampling: one point per occupied cube, the confidence-weighted mean of its points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Cloud:
    """Points in plain arrays.

    Attributes:
        positions: [N, 3] float32 world.
        colors: [N, 3] float32 sRGB.
        normals: [N, 3] float32, unit or 0.
        confidence: [N] float32 >= 1.
    """

    positions: Array
    colors: Array
    normals: Array
    confidence: Array

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: npt.NDArray[np.bool_] | npt.NDArray[np.integer] | slice) -> Cloud:
        return Cloud(
            self.positions[index], self.colors[index], self.normals[index], self.confidence[index]
        )


def voxel_index(
    positions: npt.NDArray[np.floating], size: npt.NDArray[np.floating] | float
) -> tuple[npt.NDArray[np.int64], int]:
    """Number the occupied voxels.

    Args:
        positions: [N, 3] points.
        size: edge of a voxel, one number or [N].

    Returns:
        Voxel of each point [N] int64, numbered in lexical order of the cells, and their count.
    """
    cells = _cells(positions, size)
    order = np.lexsort(cells.T[::-1])
    ranked = cells[order]
    fresh = np.ones(len(ranked), bool)
    fresh[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    index = np.empty(len(cells), np.int64)
    index[order] = np.cumsum(fresh) - 1
    return index, int(fresh.sum())


def _cells(
    positions: npt.NDArray[np.floating], size: npt.NDArray[np.floating] | float
) -> npt.NDArray[np.int64]:
    """[N, 3] the cell that each point is in."""
    points = np.asarray(positions, np.float64)
    return np.floor((points - points.min(axis=0)) / np.reshape(size, (-1, 1))).astype(np.int64)


def _count(positions: npt.NDArray[np.floating], size: float) -> int:
    """How many voxels are occupied."""
    cells = _cells(positions, size)
    across = cells.max(axis=0) + 1
    if math.prod(int(n) for n in across) >= 2**63:
        return voxel_index(positions, size)[1]
    keys = (cells[:, 0] * across[1] + cells[:, 1]) * across[2] + cells[:, 2]
    keys.sort()
    return 1 + int(np.count_nonzero(keys[1:] != keys[:-1]))


def voxel_downsample(cloud: Cloud, size: float) -> Cloud:
    """Merge the points of each voxel.

    Position, colour and normal are means weighted by the confidence above 1 (plus a little, so
    that points of confidence 1 count among themselves); the confidence is the same mean.

    Args:
        cloud: N points.
        size: edge of a voxel in world units, > 0.

    Returns:
        One point per occupied voxel, in lexical order of the voxels.
    """
    if len(cloud) == 0:
        return cloud
    index, count = voxel_index(cloud.positions, size)
    weight = np.asarray(cloud.confidence, np.float64) - 1 + 1e-3
    mass = np.bincount(index, weight, count)

    def mean(values: Array) -> npt.NDArray[np.float64]:
        columns = np.asarray(values, np.float64).reshape(len(values), -1)
        sums = [np.bincount(index, weight * column, count) for column in columns.T]
        return np.stack(sums, -1) / mass[:, None]

    normals = mean(cloud.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Normals that cancel out say nothing.
    normals = np.where(length > 0.05, normals / np.maximum(length, 1e-12), 0)
    return Cloud(
        mean(cloud.positions).astype(np.float32),
        np.clip(mean(cloud.colors), 0, 1).astype(np.float32),
        normals.astype(np.float32),
        np.maximum(mean(cloud.confidence)[:, 0], 1).astype(np.float32),
    )


def voxel_size_for(positions: npt.NDArray[np.floating], target: int, start: float) -> float:
    """The smallest voxel that leaves at most `target` points, to 0.5 %, by bisection.

    Args:
        positions: [N, 3] points.
        target: how many may be left, >= 1.
        start: a first guess (the spacing of the points).

    Returns:
        The edge in world units; 0 if there are no more than `target` points already.
    """
    if len(positions) <= target:
        return 0.0
    points = np.asarray(positions, np.float64)
    extent = float(np.ptp(points, axis=0).max())
    low, high = 0.0, max(start, extent * 1e-6)
    while _count(points, high) > target:
        low, high = high, 2 * high
        if high > 4 * extent:
            break
    while high - low > 0.005 * high:
        middle = 0.5 * (low + high)
        if _count(points, middle) > target:
            low = middle
        else:
            high = middle
    return high
