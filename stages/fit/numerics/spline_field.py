"""A smooth scalar field over points: quadratic B-splines, coarse to fine, and its gradient.

The values live on lattices whose spacing doubles from level to level. A coarse spline is a sum of
finer ones (the refinement of Chaikin), so that points only ever meet the finest lattice.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse as sparse
from numba import prange

from pipeline.kernels import helper, inlined, kernel
from stages.fit.arrays import Array, Floats, Indices, Integers
from stages.splatting.threads import KERNELS

F = np.float32

#: sums over points are taken in so many parts, whatever the number of threads
PARTS = 16
#: what a spline passes on to the finer ones at -1.5, -0.5, 0.5 and 1.5 of their spacings
REFINEMENT = (0.25, 0.75, 0.75, 0.25)


@inlined
def _along(t):  # type: ignore[no-untyped-def]
    """The three splines at `t` spacings (-0.5..0.5) from the middle one, and their slopes."""
    low, high = F(0.5) - t, F(0.5) + t
    values = (F(0.5) * low * low, F(0.75) - t * t, F(0.5) * high * high)
    return values, (-low, F(-2) * t, high)


@helper
def _evaluate_some(  # type: ignore[no-untyped-def]
    nodes: Integers, offsets: Floats, inverse: np.float32, coefficients: Floats, result: Floats
):
    for i in range(len(nodes)):
        wx, sx = _along(offsets[i, 0])
        wy, sy = _along(offsets[i, 1])
        wz, sz = _along(offsets[i, 2])
        value, x, y, z = F(0), F(0), F(0), F(0)
        for a in range(3):
            for b in range(3):
                line, slope = F(0), F(0)
                for c in range(3):
                    v = coefficients[nodes[i, 9 * a + 3 * b + c]]
                    line += v * wz[c]
                    slope += v * sz[c]
                value += line * wx[a] * wy[b]
                x += line * sx[a] * wy[b]
                y += line * wx[a] * sy[b]
                z += slope * wx[a] * wy[b]
        result[i, 0] = value
        result[i, 1] = x * inverse
        result[i, 2] = y * inverse
        result[i, 3] = z * inverse


@helper
def _gather_some(  # type: ignore[no-untyped-def]
    nodes: Integers, offsets: Floats, inverse: np.float32, gradient: Floats, sums: Floats
):
    for i in range(len(nodes)):
        wx, sx = _along(offsets[i, 0])
        wy, sy = _along(offsets[i, 1])
        wz, sz = _along(offsets[i, 2])
        by_value = gradient[i, 0]
        x, y, z = gradient[i, 1] * inverse, gradient[i, 2] * inverse, gradient[i, 3] * inverse
        for a in range(3):
            for b in range(3):
                plain = by_value * wx[a] * wy[b] + x * sx[a] * wy[b] + y * wx[a] * sy[b]
                steep = z * wx[a] * wy[b]
                for c in range(3):
                    sums[nodes[i, 9 * a + 3 * b + c]] += plain * wz[c] + steep * sz[c]


@kernel(parallel=True)
def _evaluate(  # type: ignore[no-untyped-def]
    nodes: Integers, offsets: Floats, inverse: np.float32, coefficients: Floats, result: Floats
):
    """Value and gradient at every point into `result` [N, 4]."""
    share = (len(nodes) + PARTS - 1) // PARTS
    for part in prange(PARTS):
        rows = slice(part * share, (part + 1) * share)
        _evaluate_some(nodes[rows], offsets[rows], inverse, coefficients, result[rows])


@kernel(parallel=True)
def _gather(  # type: ignore[no-untyped-def]
    nodes: Integers, offsets: Floats, inverse: np.float32, gradient: Floats, parts: Floats
):
    """What gradients [N, 4] by value and gradient come to for the coefficients: [PARTS, M]."""
    share = (len(nodes) + PARTS - 1) // PARTS
    for part in prange(PARTS):
        rows = slice(part * share, (part + 1) * share)
        _gather_some(nodes[rows], offsets[rows], inverse, gradient[rows], parts[part])


class SplineField:
    """A scalar field that points see, 0 to start with.

    Attributes:
        coefficients: [K] float32 of all levels, the finest first: what an optimiser moves.
    """

    def __init__(self, positions: Array, spacing: float, levels: int) -> None:
        """
        Args:
            positions: [N, 3] where the field is needed.
            spacing: of the finest lattice.
            levels: number of lattices, each twice as wide as the one before.
        """
        self.inverse = F(1 / spacing)
        cells = np.asarray(positions, np.float64) / spacing
        middle = np.floor(cells).astype(np.int64)
        self.offsets: Floats = (cells - middle - 0.5).astype(np.float32)
        steps = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
        lattice, self.nodes = _numbered(middle[:, None] + steps)
        self.sizes = [len(lattice)]
        self.refinements: list[sparse.csr_matrix] = []
        for _ in range(levels - 1):
            lattice, refinement = _coarser(lattice)
            self.refinements.append(refinement)
            self.sizes.append(len(lattice))
        self.transposed = [refinement.T.tocsr() for refinement in self.refinements]
        self.coefficients: Floats = np.zeros(sum(self.sizes), np.float32)

    def evaluate(self) -> tuple[Floats, Floats]:
        """The field's value [N] and gradient [N, 3] at the points."""
        levels = np.split(self.coefficients, np.cumsum(self.sizes)[:-1])
        total = levels[-1]
        for own, refinement in zip(levels[-2::-1], self.refinements[::-1], strict=True):
            total = own + refinement @ total
        result = np.empty((len(self.nodes), 4), np.float32)
        with KERNELS:
            _evaluate(self.nodes, self.offsets, self.inverse, total, result)
        return result[:, 0], result[:, 1:]

    def gather(self, gradient: Floats) -> Floats:
        """[K] gradient by the coefficients, of what has `gradient` [N, 4] by value and gradient."""
        parts = np.zeros((PARTS, self.sizes[0]), np.float32)
        with KERNELS:
            _gather(self.nodes, self.offsets, self.inverse, gradient, parts)
        levels = [parts.sum(axis=0)]
        for transposed in self.transposed:
            levels.append(transposed @ levels[-1])
        return np.concatenate(levels)

    def select(self, source: Indices) -> None:
        """Points follow `source` [N']; the lattices stay."""
        self.nodes = np.ascontiguousarray(self.nodes[source])
        self.offsets = np.ascontiguousarray(self.offsets[source])


def _numbered(cells: Indices) -> tuple[Indices, Integers]:
    """Distinct cells [M, 3] among [..., 3], in order, and which of them each is [...]."""
    flat = cells.reshape(-1, 3)
    low = flat.min(axis=0)
    size = flat.max(axis=0) - low + 1
    keys = ((flat[:, 0] - low[0]) * size[1] + flat[:, 1] - low[1]) * size[2] + flat[:, 2] - low[2]
    # faster than `numpy.unique`, which hashes
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    new = np.diff(ordered, prepend=ordered[0] - 1) > 0
    distinct, index = ordered[new], np.empty(len(keys), np.int64)
    index[order] = np.cumsum(new) - 1
    lattice = np.stack([distinct // (size[1] * size[2]), distinct // size[2] % size[1],
                        distinct % size[2]], axis=1) + low  # fmt: skip
    return lattice, index.reshape(cells.shape[:-1]).astype(np.int32)


def _coarser(
    lattice: Indices,
) -> tuple[Indices, sparse.csr_matrix]:
    """The cells [C, 3] of twice the size that reach those given [M, 3], and how much [M, C]."""
    # a fine cell lies in one half of a coarse one, and also takes from the neighbour on that side
    own = lattice >> 1
    side = 2 * (lattice & 1) - 1
    choices = np.array(list(itertools.product((0, 1), repeat=3)))
    coarse, index = _numbered(own[:, None] + choices * side[:, None])
    share = np.array(REFINEMENT)[1 - choices].prod(axis=1)
    rows = np.repeat(np.arange(len(lattice)), len(choices))
    values = np.tile(share, len(lattice)).astype(np.float32)
    shape = (len(lattice), len(coarse))
    return coarse, sparse.csr_matrix((values, (rows, index.ravel())), shape=shape)
