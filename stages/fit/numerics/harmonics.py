"""How colours turn with the view where no photograph tells: as they do beside it.

A Gaussian that one photograph shows may have any harmonics that come to its colour there. What is
seen of it from elsewhere is then what they happened to be. Where a second photograph, of another
exposure or in another light, tells those of its neighbours, the border of what that one shows is an
edge across a tooth. So the harmonics above the constant are made to change as little as they can
from one Gaussian to the next, while every photograph's colours stay: a membrane, held where there
are photographs. The constant is free, as neighbours may have any colour. And where it is known what
a view is to see, they are changed by no more than that takes.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from pipeline.kernels import kernel
from pipeline.kernels.threads import in_threads
from stages.fit.arrays import Array, Floats, Integers
from stages.splatting.threads import KERNELS, workers

F = np.float32
CHUNK = 256
#: holds what neither a photograph nor a neighbour does
LEAST = 1e-6
#: the residual, squared, against what it was: float32 holds no less
SOLVED = 1e-10
#: what a change of the constant counts against one of another term: colours change as a whole
CONSTANT = 0.01
#: how far views give in that look from nearly the same side but want different colours: those that
#: nothing is known from, and those that keep what they see
WISHED, KEPT = 1e-2, 1e-4
#: Gaussians that a thread prepares in one go
BLOCK = 4096


@kernel(parallel=True)
def _stretched(move: Floats, grams: Floats, neighbours: Integers, starts: Integers, out: Floats):  # type: ignore[no-untyped-def]
    """What the membrane and the photographs pull back with: [N, K, 3] of moves [N, K, 3]."""
    number, terms, _ = move.shape
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            degree = F(starts[i + 1] - starts[i])
            for k in range(terms):
                for c in range(3):
                    total = F(LEAST) * move[i, k, c]
                    for other in range(terms):
                        total += grams[i, k, other] * move[i, other, c]
                    out[i, k, c] = total + (degree * move[i, k, c] if k > 0 else F(0))
            for edge in range(starts[i], starts[i + 1]):
                j = neighbours[edge]
                for k in range(1, terms):
                    for c in range(3):
                        out[i, k, c] -= move[j, k, c]


@kernel(parallel=True)
def _times(blocks: Floats, values: Floats, out: Floats):  # type: ignore[no-untyped-def]
    """Each of [N, K, K] times each of [N, K, 3]."""
    number, terms, _ = values.shape
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            for k in range(terms):
                for c in range(3):
                    total = F(0)
                    for other in range(terms):
                        total += blocks[i, k, other] * values[i, other, c]
                    out[i, k, c] = total


def spread(
    harmonics: Floats, basis: Array, pixels: Array, neighbours: Integers, starts: Integers,
    firmness: float, steps: int,
) -> Floats:  # fmt: skip
    """Harmonics that turn like those beside them where no photograph says how.

    Conjugate gradients (Hestenes and Stiefel 1952) on the membrane's normal equations, with the
    inverse of each Gaussian's own block for a preconditioner.

    Args:
        harmonics: [N, K, 3] coefficients, the constant first.
        basis: [V, N, K] what each of them adds to what each view sees.
        pixels: [V, N] of each view that a Gaussian colours.
        neighbours, starts: who is beside whom (see `total_variation.connected`).
        firmness: what a pixel counts against a neighbour.
        steps: of conjugate gradients.

    Returns:
        [N, K, 3] float32.
    """
    terms = harmonics.shape[1]
    start = np.ascontiguousarray(harmonics, np.float32)
    degrees = np.diff(starts)[:, None]
    grams, blocks = (np.empty((len(start), terms, terms), np.float32) for _ in range(2))

    def prepare(rows: slice) -> None:
        seen = np.ascontiguousarray(np.moveaxis(basis[:, rows], 0, 1), np.float64)  # [B, V, K]
        own = np.swapaxes(seen * (firmness * pixels[:, rows].T)[:, :, None], 1, 2) @ seen
        grams[rows] = own
        own += LEAST * np.eye(terms)
        own[:, range(1, terms), range(1, terms)] += degrees[rows]
        blocks[rows] = np.linalg.inv(own)

    in_threads(prepare, _pieces(len(start)), workers())
    pull, better = np.empty_like(start), np.empty_like(start)
    with KERNELS:
        _stretched(start, np.zeros_like(grams), neighbours, starts, pull)
        rest = F(LEAST) * start - pull
        _times(blocks, rest, better)
        direction, move, now = better.copy(), np.zeros_like(start), _product(rest, better)
        enough = SOLVED * now
        for _ in range(steps):
            if now <= enough:
                break
            _stretched(direction, grams, neighbours, starts, pull)
            length = F(now / _product(direction, pull))
            move += length * direction
            rest -= length * pull
            _times(blocks, rest, better)
            before, now = now, _product(rest, better)
            direction = better + F(now / before) * direction
    return np.asarray(start + move, np.float32)


def reaching(harmonics: Floats, basis: Array, wanted: Array, sure: Array) -> Floats:
    """Harmonics [N, K, 3], changed as little as can be, that come to colours in several views.

    Args:
        harmonics: [N, K, 3] coefficients, the constant first.
        basis: [V, N, K] what each of them adds to what each view sees.
        wanted: [V, N, 3] what each view is to see.
        sure: [V, N] 1 where that must be so, 0 where it is a wish.
    """
    found, each = harmonics.copy(), range(len(basis))

    def reach(rows: slice) -> None:
        seen = np.moveaxis(basis[:, rows], 0, 1)  # [B, V, K]
        missing = np.moveaxis(wanted[:, rows], 0, 1) - seen @ harmonics[rows]
        cheap = seen.copy()
        cheap[:, :, 0] /= CONSTANT
        overlap = cheap @ np.swapaxes(seen, 1, 2)
        overlap[:, each, each] += KEPT + (WISHED - KEPT) * (1 - sure[:, rows].T)
        found[rows] += np.swapaxes(cheap, 1, 2) @ np.linalg.solve(overlap, missing)

    in_threads(reach, _pieces(len(harmonics)), workers())
    return found


def _pieces(number: int) -> list[slice]:
    return [slice(first, first + BLOCK) for first in range(0, number, BLOCK)]


@kernel(parallel=True)
def _take_in(basis: Array, wanted: Array, open_to: Array, found: Array):  # type: ignore[no-untyped-def]
    """Recursive least squares: what one more view sees of each; see `Nearest`."""
    number, terms = basis.shape
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        gain = np.empty(terms)
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            certainty = 1.0
            for k in range(terms):
                gain[k] = 0.0
                for other in range(terms):
                    gain[k] += open_to[i, k, other] * basis[i, other]
                certainty += gain[k] * basis[i, k]
            for c in range(3):
                missing = wanted[i, c]
                for k in range(terms):
                    missing -= basis[i, k] * found[i, k, c]
                for k in range(terms):
                    found[i, k, c] += gain[k] * missing / certainty
            for k in range(terms):
                for other in range(terms):
                    open_to[i, k, other] -= gain[k] * gain[other] / certainty


class Nearest:
    """Harmonics that come nearest to what views see, and to given ones in all that these leave.

    Least squares of every Gaussian on its own, view by view (Plackett 1950): no view is kept.

    Attributes:
        found: [N, K, 3] float64 as things stand.
    """

    def __init__(self, given: Array, trust: Array) -> None:
        """
        Args:
            given: [N, K, 3].
            trust: [K] what a difference from them counts, squared, against one from a view.
        """
        self.found = given.astype(np.float64)
        self._open_to = np.empty((*given.shape[:2], given.shape[1]))
        self._open_to[:] = np.diag(1 / trust)

    def add(self, basis: Array, wanted: Floats) -> None:
        """A view sees [N, 3] by [N, K], what each coefficient adds to it."""
        seen_by, seen = (np.ascontiguousarray(array, np.float64) for array in (basis, wanted))
        with KERNELS:
            _take_in(seen_by, seen, self._open_to, self.found)


def _product(a: Floats, b: Floats) -> float:
    return float((a * b).sum(dtype=np.float64))
