"""Semi-global aggregation of a cost volume, and the depth it decides for.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, along
four paths (left, right, up, down).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.kernels import each, helper, kernel
from stages.stereo.tiles import TILE, Buffer, full_ranges

Array = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]

_FAR = np.float32(1e9)


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
def _horizontal(y, volume, penalty, p1, ranges, tile, total):  # type: ignore[no-untyped-def]
    """The paths along row y, both ways; they begin the sum."""
    width, planes = volume.shape[1:]
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
            if x // columns != before:
                before = x // columns
                low, high = ranges[first + before, 0], ranges[first + before, 1]
                fresh = 0
            if fresh < 2:
                _begin(current, low, high)
                fresh += 1
            if direction == 0:
                total[y, x, low:high] = 0
            least = _step(
                volume[y, x, low:high], previous[low : high + 2], least, p1, penalty[y, x],
                current[low : high + 2], total[y, x, low:high],
            )  # fmt: skip
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _vertical(strip, volume, penalty, p1, ranges, tile, total):  # type: ignore[no-untyped-def]
    """The paths along a strip of columns, as wide as a tile, both ways."""
    height, width, planes = volume.shape
    rows, columns = tile
    across = -(-width // columns)
    x0 = strip * columns
    x1 = min(x0 + columns, width)
    for direction in range(2):
        previous = np.full((x1 - x0, planes + 2), _FAR)
        current = np.full((x1 - x0, planes + 2), _FAR)
        start = strip if direction == 0 else (height - 1) // rows * across + strip
        low, high = ranges[start, 0], ranges[start, 1]
        previous[:, low + 1 : high + 1] = 0
        least = np.zeros(x1 - x0, np.float32)
        for step in range(height):
            y = step if direction == 0 else height - 1 - step
            here = y // rows * across + strip
            low, high = ranges[here, 0], ranges[here, 1]
            # The first two rows in a tile: each of the two buffers must learn of its range.
            into = min(y % rows, step) if direction == 0 else min(rows - 1 - y % rows, step)
            for k in range(x1 - x0):
                x = x0 + k
                if into < 2:
                    _begin(current[k], low, high)
                least[k] = _step(
                    volume[y, x, low:high], previous[k, low : high + 2], least[k], p1,
                    penalty[y, x], current[k, low : high + 2], total[y, x, low:high],
                )  # fmt: skip
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _decide(band, total, volume, ranges, tile, plane, ncc, margin):  # type: ignore[no-untyped-def]
    """`decide` for a row of tiles."""
    height, width, _ = total.shape
    rows, columns = tile
    across = -(-width // columns)
    for y in range(band * rows, min((band + 1) * rows, height)):
        for x in range(width):
            here = band * across + x // columns
            low, high = ranges[here, 0], ranges[here, 1]
            sums = total[y, x]
            least = _FAR
            for d in range(low, high):
                least = min(least, sums[d])
            best = low
            while best < high - 1 and sums[best] > least:
                best += 1
            second = _FAR
            for d in range(low, best - 2):
                second = min(second, sums[d])
            for d in range(best + 3, high):
                second = min(second, sums[d])
            offset = np.float32(0)
            if low < best < high - 1:
                left, middle, right = sums[best - 1], sums[best], sums[best + 1]
                curvature = left + right - 2 * middle
                if curvature > np.float32(1e-6):
                    offset = np.float32(0.5) * (left - right) / curvature
            plane[y, x] = np.float32(best) + offset
            ncc[y, x] = np.float32(1) - volume[y, x, best]
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


def aggregate(
    volume: Array, penalty: Array, p1: float, ranges: Integers | None = None,
    buffer: Buffer | None = None,
) -> Array:  # fmt: skip
    """Sum of the path costs of a volume.

    Args:
        volume: [H, W, D] float32.
        penalty: [H, W] float32, P2 of each pixel.
        p1: for a change by one plane.
        ranges: [T, 2] int64 first plane and the one after the last of every tile (`tiles`), those
            of `cost_volume`; None: all planes.
        buffer: where the result goes; None: into memory of its own.

    Returns:
        [H, W, D] float32, of use inside the ranges.
    """
    total = (buffer or Buffer()).of(volume.shape)
    height, width, planes = volume.shape
    ranges = full_ranges((height, width), planes) if ranges is None else ranges
    each(_horizontal, height, volume, penalty, np.float32(p1), ranges, TILE, total)
    each(_vertical, -(-width // TILE[1]), volume, penalty, np.float32(p1), ranges, TILE, total)
    return total


def decide(
    total: Array, volume: Array, ranges: Integers | None = None
) -> tuple[Array, Array, Array]:
    """Winner takes all, with a parabola through the best plane and its two neighbours.

    Args:
        total: [H, W, D] float32 aggregated cost.
        volume: [H, W, D] float32 raw cost.
        ranges: as for `aggregate`.

    Returns:
        Plane index with fraction, ZNCC there, and the cost margin to the best plane more than two
        away, each [H, W] float32.
    """
    height, width, planes = total.shape
    ranges = full_ranges((height, width), planes) if ranges is None else ranges
    plane, ncc, margin = (np.empty((height, width), np.float32) for _ in range(3))
    each(_decide, -(-height // TILE[0]), total, volume, ranges, TILE, plane, ncc, margin)
    return plane, ncc, margin
