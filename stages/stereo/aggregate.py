"""Semi-global aggregation of a cost volume, and the depth it decides for.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, along
four paths (left, right, up, down).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.kernels import each, helper, kernel

Array = npt.NDArray[np.float32]

_BAND = 8
_STRIP = 16
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


@kernel(fastmath=True, nogil=True)
def _horizontal(y, volume, penalty, p1, total):  # type: ignore[no-untyped-def]
    """The paths along row y, both ways."""
    width, planes = volume.shape[1:]
    for direction in range(2):
        previous = np.zeros(planes + 2, np.float32)
        current = np.zeros(planes + 2, np.float32)
        previous[0] = previous[planes + 1] = _FAR
        current[0] = current[planes + 1] = _FAR
        least = np.float32(0)
        for step in range(width):
            x = step if direction == 0 else width - 1 - step
            least = _step(volume[y, x], previous, least, p1, penalty[y, x], current, total[y, x])
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _vertical(strip, volume, penalty, p1, total):  # type: ignore[no-untyped-def]
    """The paths along a strip of columns, both ways."""
    height, width, planes = volume.shape
    x0 = strip * _STRIP
    x1 = min(x0 + _STRIP, width)
    for direction in range(2):
        previous = np.zeros((x1 - x0, planes + 2), np.float32)
        current = np.zeros((x1 - x0, planes + 2), np.float32)
        previous[:, 0] = _FAR
        previous[:, planes + 1] = _FAR
        current[:, 0] = _FAR
        current[:, planes + 1] = _FAR
        least = np.zeros(x1 - x0, np.float32)
        for step in range(height):
            y = step if direction == 0 else height - 1 - step
            for k in range(x1 - x0):
                x = x0 + k
                least[k] = _step(
                    volume[y, x], previous[k], least[k], p1, penalty[y, x], current[k], total[y, x]
                )
            previous, current = current, previous


@kernel(fastmath=True, nogil=True)
def _decide(band, total, volume, plane, ncc, margin):  # type: ignore[no-untyped-def]
    """`decide` for a band of rows."""
    height, width, planes = total.shape
    for y in range(band * _BAND, min((band + 1) * _BAND, height)):
        for x in range(width):
            sums = total[y, x]
            best = 0
            for d in range(1, planes):
                if sums[d] < sums[best]:
                    best = d
            second = _FAR
            for d in range(planes):
                if abs(d - best) > 2 and sums[d] < second:
                    second = sums[d]
            offset = np.float32(0)
            if 0 < best < planes - 1:
                left, middle, right = sums[best - 1], sums[best], sums[best + 1]
                curvature = left + right - 2 * middle
                if curvature > np.float32(1e-6):
                    offset = np.float32(0.5) * (left - right) / curvature
            plane[y, x] = np.float32(best) + offset
            ncc[y, x] = np.float32(1) - volume[y, x, best]
            margin[y, x] = second - sums[best]


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


def aggregate(volume: Array, penalty: Array, p1: float) -> Array:
    """Sum of the path costs of a volume [H, W, D]; `penalty` [H, W] is P2 of each pixel."""
    total = np.zeros_like(volume)
    height, width, _ = volume.shape
    each(_horizontal, height, volume, penalty, np.float32(p1), total)
    each(_vertical, -(-width // _STRIP), volume, penalty, np.float32(p1), total)
    return total


def decide(total: Array, volume: Array) -> tuple[Array, Array, Array]:
    """Winner takes all, with a parabola through the best plane and its two neighbours.

    Args:
        total: [H, W, D] float32 aggregated cost.
        volume: [H, W, D] float32 raw cost.

    Returns:
        Plane index with fraction, ZNCC there, and the cost margin to the best plane more than two
        away, each [H, W] float32.
    """
    shape = total.shape[:2]
    plane, ncc, margin = (np.empty(shape, np.float32) for _ in range(3))
    each(_decide, -(-shape[0] // _BAND), total, volume, plane, ncc, margin)
    return plane, ncc, margin
