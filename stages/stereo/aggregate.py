"""Semi-global aggregation of a cost volume, and the depth it decides for.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, along
four paths (left, right, up, down).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.kernels import each, helper, kernel
from stages.stereo.tiles import TILE, Buffer, Volume

Array = npt.NDArray[np.float32]

_FAR = np.float32(1e9)
#: Columns that go down an image at once; a tile has as many, or all.
_STRIP = TILE[1]


@helper(fastmath=True)
def _step(cost, previous, previous_min, p1, p2, current, total):  # type: ignore[no-untyped-def]
    """One pixel of a path: previous and current are padded by one on both sides."""
    limit = previous_min + p2
    least = _FAR
    for d in range(cost.shape[0]):
        a = previous[d + 1]
        b = min(previous[d], previous[d + 2]) + p1
        value = cost[d] + min(min(a, b), limit) - previous_min
        current[d + 1] = value
        total[d] += value
        least = min(least, value)
    return least


@helper(fastmath=True)
def _begin(path, low, high):  # type: ignore[no-untyped-def]
    """Make room on a path for a tile's range of planes: all others are too far."""
    path[: low + 1] = _FAR
    path[high + 1 :] = _FAR


@kernel(fastmath=True, nogil=True)
def _horizontal(y, values, starts, ranges, tile, shape, penalty, p1, total):  # type: ignore[no-untyped-def]
    """The paths along row y, both ways; they begin the sum."""
    width, planes = shape[1], shape[2]
    rows, columns = tile
    first = y // rows * -(-width // columns)
    for direction in range(2):
        previous = np.full(planes + 2, _FAR)
        current = np.full(planes + 2, _FAR)
        start = first if direction == 0 else first + (width - 1) // columns
        low, high = ranges[start, 0], ranges[start, 1]
        previous[low + 1 : high + 1] = 0
        least = np.float32(0)
        fresh = 0  # pixels since the range changed: each of the two buffers must learn of it
        before = -1
        for step in range(width):
            x = step if direction == 0 else width - 1 - step
            here = first + x // columns
            if here != before:
                before = here
                low, high = ranges[here, 0], ranges[here, 1]
                fresh = 0
            if fresh < 2:
                _begin(current, low, high)
                fresh += 1
            at = starts[here] + (y % rows * columns + x % columns) * (high - low)
            end = at + high - low
            if direction == 0:
                total[at:end] = 0
            least = _step(
                values[at:end], previous[low : high + 2], least, p1, penalty[y, x],
                current[low : high + 2], total[at:end],
            )  # fmt: skip
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _vertical(strip, values, starts, ranges, tile, shape, penalty, p1, total):  # type: ignore[no-untyped-def]
    """The paths along a strip of columns of one tile, both ways."""
    height, width, planes = shape
    rows, columns = tile
    across = -(-width // columns)
    x0 = strip * _STRIP
    x1 = min(x0 + _STRIP, width)
    column = x0 // columns
    for direction in range(2):
        previous = np.full((x1 - x0, planes + 2), _FAR)
        current = np.full((x1 - x0, planes + 2), _FAR)
        start = column if direction == 0 else (height - 1) // rows * across + column
        low, high = ranges[start, 0], ranges[start, 1]
        previous[:, low + 1 : high + 1] = 0
        least = np.zeros(x1 - x0, np.float32)
        for step in range(height):
            y = step if direction == 0 else height - 1 - step
            here = y // rows * across + column
            low, high = ranges[here, 0], ranges[here, 1]
            # The first two rows in a tile: each of the two buffers must learn of its range.
            into = min(y % rows, step) if direction == 0 else min(rows - 1 - y % rows, step)
            for k in range(x1 - x0):
                x = x0 + k
                at = starts[here] + (y % rows * columns + x % columns) * (high - low)
                end = at + high - low
                if into < 2:
                    _begin(current[k], low, high)
                least[k] = _step(
                    values[at:end], previous[k, low : high + 2], least[k], p1,
                    penalty[y, x], current[k, low : high + 2], total[at:end],
                )  # fmt: skip
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _decide(y, sums, costs, starts, ranges, tile, shape, plane, ncc, margin):  # type: ignore[no-untyped-def]
    """`decide` for a row of pixels."""
    width = shape[1]
    rows, columns = tile
    first = y // rows * -(-width // columns)
    for x in range(width):
        here = first + x // columns
        planes = ranges[here, 1] - ranges[here, 0]
        at = starts[here] + (y % rows * columns + x % columns) * planes
        own = sums[at : at + planes]
        least = _FAR
        for d in range(planes):
            least = min(least, own[d])
        best = 0
        while best < planes - 1 and own[best] > least:
            best += 1
        second = _FAR
        for d in range(best - 2):
            second = min(second, own[d])
        for d in range(best + 3, planes):
            second = min(second, own[d])
        offset = np.float32(0)
        if 0 < best < planes - 1:
            left, middle, right = own[best - 1], own[best], own[best + 1]
            curvature = left + right - 2 * middle
            if curvature > np.float32(1e-6):
                offset = np.float32(0.5) * (left - right) / curvature
        plane[y, x] = np.float32(ranges[here, 0] + best) + offset
        ncc[y, x] = np.float32(1) - costs[at + best]
        margin[y, x] = second - least


def edge_aware_penalty(gray: Array, p2: float, falloff: float = 20.0) -> Array:
    """P2 of every pixel, smaller on image edges, where depth is allowed to jump.

    Args:
        gray: [H, W] float32 grey in 0..1.
        p2: the penalty on flat areas.
        falloff: how fast it falls with the gradient (per grey range and pixel).

    Returns:
        [H, W] float32.
    """
    gy, gx = np.gradient(gray.astype(np.float32))
    return (np.float32(p2) / (1 + np.float32(falloff) * np.hypot(gx, gy))).astype(np.float32)


def aggregate(volume: Volume, penalty: Array, p1: float, buffer: Buffer | None = None) -> Volume:
    """Sum of the path costs of a volume.

    Args:
        volume: matching costs.
        penalty: [H, W] float32, P2 of each pixel.
        p1: for a change by one plane.
        buffer: where the result goes; None: into memory of its own.
    """
    total = volume.like(buffer)
    height, width, _ = volume.shape
    given = volume.values, *volume.layout, penalty, np.float32(p1), total.values
    each(_horizontal, height, *given)
    each(_vertical, -(-width // _STRIP), *given)
    return total


def decide(total: Volume, volume: Volume) -> tuple[Array, Array, Array]:
    """Winner takes all, with a parabola through the best plane and its two neighbours.

    Args:
        total: aggregated costs.
        volume: raw costs, of the same pixels and planes.

    Returns:
        Plane index with fraction, ZNCC there, and the cost margin to the best plane more than two
        away, each [H, W] float32.
    """
    height, width, _ = total.shape
    plane, ncc, margin = (np.empty((height, width), np.float32) for _ in range(3))
    each(_decide, height, total.values, volume.values, *total.layout, plane, ncc, margin)
    return plane, ncc, margin
