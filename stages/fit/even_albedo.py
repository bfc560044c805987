"""Neighbours mostly have the same albedo: what changes from one to the next is more often shading.

A photograph alone can't tell a dark tissue from one that is turned away. Intrinsic images settle it
by a prior on albedo (Land and McCann 1971, "Lightness and Retinex Theory"): it is piecewise even.
Here it is the total variation over a graph of neighbours, rounded off near 0 (Huber).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.spatial import cKDTree

from stages.fit.checkpoint import Arrays
from stages.splatting.threads import KERNELS

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
F = np.float32


@njit(parallel=True, cache=True, error_model="numpy")
def _variation(  # type: ignore[no-untyped-def]
    material: Floats, neighbours: Integers, starts: Integers, tolerance: np.float32,
    weight: np.float32, gradient: Floats, loss: Floats,
):  # fmt: skip
    """Add the gradient by the first three columns of `material`; each row's share of the loss."""
    for i in prange(len(material)):
        total = F(0)
        for channel in range(3):
            slope = F(0)
            for edge in range(starts[i], starts[i + 1]):
                d = material[i, channel] - material[neighbours[edge], channel]
                part = min(max(d / tolerance, F(-1)), F(1))
                slope += part
                total += part * (d - F(0.5) * tolerance * part)
            gradient[i, channel] += weight * slope
        loss[i] = F(0.5) * weight * total  # each pair is met from both of its ends


class EvenAlbedo:
    """Weight times the mean, over Gaussians and their neighbours, of how albedos differ.

    Attributes:
        neighbours, starts: the graph's edges from both ends: those of Gaussian i are
            neighbours[starts[i]:starts[i + 1]]; None until it is needed.
    """

    def __init__(self, weight: float, neighbours: int, tolerance: float) -> None:
        """
        Args:
            weight: against a colour loss that is a mean over the pixels.
            neighbours: a Gaussian is compared to so many of the nearest, and with those that it is
                one of the nearest to.
            tolerance: differences of albedo below this count by their squares.
        """
        self.weight = weight
        self.count = neighbours
        self.tolerance = tolerance
        self.neighbours: Integers | None = None
        self.starts: Integers = np.zeros(1, np.int32)

    def add(self, positions: Floats, material: Floats, gradient: Floats) -> float:
        """Add to the gradient [N, 6] by a material [N, 6]; returns the loss.

        The graph is that of the positions [N, 3] when it is first asked for.
        """
        number = len(material)
        if self.weight == 0 or number <= 1:
            return 0.0
        if self.neighbours is None:
            self._connect(positions)
        assert self.neighbours is not None
        loss = np.empty(number, np.float32)
        with KERNELS:
            _variation(
                material, self.neighbours, self.starts, F(self.tolerance),
                F(self.weight / (number * self.count)), gradient, loss,
            )  # fmt: skip
        return float(loss.sum(dtype=np.float64))

    def _connect(self, positions: Floats) -> None:
        number = len(positions)
        count = min(self.count, number - 1)
        _, found = cKDTree(positions).query(positions, k=count + 1)
        own = np.repeat(np.arange(number), count + 1)
        pairs = np.stack([own, found.ravel()], 1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        both = np.concatenate([pairs, pairs[:, ::-1]])
        keys = np.unique(both[:, 0] * number + both[:, 1])
        self.neighbours = (keys % number).astype(np.int32)
        self.starts = np.searchsorted(keys // number, np.arange(number + 1)).astype(np.int32)

    def forget(self) -> None:
        """Other Gaussians have taken the place of those that were compared."""
        self.neighbours = None

    def arrays(self) -> Arrays:
        """The whole state, for a checkpoint."""
        if self.neighbours is None:
            return {}
        return {"albedo_neighbours": self.neighbours, "albedo_starts": self.starts}

    def restore(self, arrays: Arrays) -> None:
        """Take up what `arrays` gave."""
        self.neighbours = arrays.get("albedo_neighbours")
        self.starts = arrays.get("albedo_starts", self.starts)
