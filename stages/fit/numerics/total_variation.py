"""Neighbours mostly have the same colour: what changes from one to the next is more often shading.

A photograph alone can't tell a dark tissue from one that is turned away, and what no other one has
seen from there, a Gaussian may have in any colour. Intrinsic images settle it by a prior: albedo is
piecewise even (Land and McCann 1971, "Lightness and Retinex Theory"). Here it is the total
variation over a graph of neighbours (Rudin, Osher and Fatemi 1992), rounded off near 0 (Huber).
"""

from __future__ import annotations

import numpy as np
from numba import prange
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from pipeline.kernels import inlined, kernel
from stages.fit.arrays import Floats, Integers
from stages.splatting.lanes.types import WIDTH
from stages.splatting.lanes.vectors import (
    at_least,
    at_most,
    count_up,
    load_from,
    spread,
    store_from,
    where,
)
from stages.splatting.threads import KERNELS, workers

F = np.float32
CHUNK = 256
#: So many positions ask for their neighbours in one go.
QUERIES = 32768


@inlined
def _slope(difference):  # type: ignore[no-untyped-def]
    return min(max(difference, F(-1)), F(1))


@kernel(parallel=True, fastmath=True)
def _few_columns(  # type: ignore[no-untyped-def]
    values: Floats, first: int, last: int, neighbours: Integers, starts: Integers,
    inverse: np.float32, weight: np.float32, gradient: Floats,
):  # fmt: skip
    """Three columns at a time."""
    for chunk in prange((len(values) + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(len(values), (chunk + 1) * CHUNK)):
            for k in range(first, last, 3):
                a, b, c = values[i, k], values[i, k + 1], values[i, k + 2]
                by_a, by_b, by_c = F(0), F(0), F(0)
                for edge in range(starts[i], starts[i + 1]):
                    j = neighbours[edge]
                    by_a += _slope((a - values[j, k]) * inverse)
                    by_b += _slope((b - values[j, k + 1]) * inverse)
                    by_c += _slope((c - values[j, k + 2]) * inverse)
                gradient[i, k] += weight * by_a
                gradient[i, k + 1] += weight * by_b
                gradient[i, k + 2] += weight * by_c


@kernel(parallel=True, fastmath=True)
def _many_columns(  # type: ignore[no-untyped-def]
    values: Floats, first: int, last: int, neighbours: Integers, starts: Integers,
    inverse: np.float32, weight: np.float32, gradient: Floats,
):  # fmt: skip
    """Sixteen columns at a time; the last sixteen may overlap with those before."""
    stride, columns = values.shape[1], last - first
    blocks = (columns + WIDTH - 1) // WIDTH
    for chunk in prange((len(values) + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(len(values), (chunk + 1) * CHUNK)):
            for block in range(blocks):
                start = min(block * WIDTH, columns - WIDTH)
                place = i * stride + first + start
                own = load_from(values, place)
                total = spread(F(0))
                for edge in range(starts[i], starts[i + 1]):
                    other = load_from(values, neighbours[edge] * stride + first + start)
                    total += at_most(at_least((own - other) * inverse, F(-1)), F(1))
                done = F(block * WIDTH - start)
                total = where(count_up() < done, spread(F(0)), total)
                store_from(gradient, place, load_from(gradient, place) + total * weight)


def connected(positions: Floats, count: int) -> tuple[Integers, Integers]:
    """Who is near whom: two Gaussians of which one is among the other's nearest, from both ends.

    Args:
        positions: [N, 3], more than one.
        count: so many are nearest.

    Returns:
        [E] neighbours, and [N + 1] starts: those of i are neighbours[starts[i]:starts[i + 1]].
    """
    number = len(positions)
    count = min(count, number - 1)
    tree, threads = cKDTree(positions), workers()
    found = np.empty((number, count + 1), np.int32)
    for start in range(0, number, QUERIES):  # what the tree returns is four times as large
        some = positions[start : start + QUERIES]
        found[start : start + QUERIES] = tree.query(some, k=count + 1, workers=threads)[1]
    others = found != np.arange(number, dtype=np.int32)[:, None]
    starts = np.concatenate([[0], np.cumsum(others.sum(axis=1))]).astype(np.int32)
    one_way = csr_array((np.ones(starts[-1], bool), found[others], starts), (number, number))
    one_way.sort_indices()
    both = one_way + one_way.T.tocsr()
    return both.indices, both.indptr


class TotalVariation:
    """Weight times the mean, over Gaussians and their neighbours, of how their colours differ.

    Attributes:
        neighbours, starts: the graph's edges from both ends: those of Gaussian i are
            neighbours[starts[i]:starts[i + 1]]; None until they are needed.
    """

    def __init__(self, weight: float, neighbours: int, tolerance: float) -> None:
        """
        Args:
            weight: against a colour loss that is a mean over the pixels.
            neighbours: a Gaussian is compared to so many of the nearest, and with those that it is
                one of the nearest to.
            tolerance: differences of colour below this count by their squares.
        """
        self.weight = weight
        self.count = neighbours
        self.tolerance = tolerance
        self.neighbours: Integers | None = None
        self.starts: Integers = np.zeros(1, np.int32)

    def add(
        self, positions: Floats, values: Floats, first: int, last: int, gradient: Floats,
        unit: float = 1.0,
    ) -> None:  # fmt: skip
        """Add to the gradient by some columns.

        Args:
            positions: [N, 3]; the graph is that of the positions when it is first asked for.
            values: [N, D] contiguous; columns `first` to `last` - 1 are colours, three each.
            gradient: [N, D] contiguous.
            unit: the colour that 1 in these columns is.
        """
        number = len(values)
        if self.weight == 0 or number <= 1:
            return
        neighbours = self.neighbours
        if neighbours is None:
            neighbours, self.starts = connected(positions, self.count)
            self.neighbours = neighbours
        inverse = F(unit / self.tolerance)
        weight = F(self.weight * unit / (number * self.count))
        kernel = _many_columns if last - first >= WIDTH else _few_columns
        with KERNELS:
            kernel(values, first, last, neighbours, self.starts, inverse, weight, gradient)

    def forget(self) -> None:
        """Other Gaussians have taken the place of those that were compared."""
        self.neighbours = None
