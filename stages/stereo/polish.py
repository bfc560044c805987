"""PatchMatch polish: slanted windows instead of fronto-parallel ones, where a sweep has been.

Each pixel holds a plane (inverse depth and its slopes in the image). It tries the planes of its
neighbours and a few small changes of its own, and keeps what correlates best (Bleyer et al.,
"PatchMatch Stereo", BMVC 2011, in a red-black order as Galliani et al., ICCV 2015).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import helper, kernel

Array = npt.NDArray[np.float32]
F = np.float32

#: Steps to the neighbours that are asked: of the other colour, all of them.
_STEPS = np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [-5, 0], [5, 0], [0, -5], [0, 5]], np.int64)
#: Random changes of its own plane that a pixel tries, halved from one to the next.
_CHANGES = 3
#: Correlation of what can't be compared.
_NOTHING = F(-1)


def source_maps(reference: Camera, sources: list[Camera]) -> Array:
    """[S, 12] float32: a pixel (u, v, 1) at inverse depth w is seen at A (u, v, 1) + w b; A, b."""
    inverse_matrix = np.linalg.inv(reference.matrix)
    rows = []
    for source in sources:
        relative = source.cam_from_world @ np.linalg.inv(reference.cam_from_world)
        turned = source.matrix @ relative[:3, :3] @ inverse_matrix
        rows.append(np.concatenate([turned.ravel(), source.matrix @ relative[:3, 3]]))
    return np.array(rows, np.float32).reshape(-1, 12)


def polish(
    gray: Array, usable: npt.NDArray[np.bool_], stack: Array, sizes: Array, maps: Array,
    depth: Array, score: Array, passes: int, window: int, step: float, seed: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Improve a depth map.

    Args:
        gray, usable: the view [H, W].
        stack, sizes: its sources, as `sweep.stack_sources` has them.
        maps: [S, 12], see `source_maps`.
        depth: [H, W] float32, 0 where there is none.
        score: [H, W] float32 correlation of it.
        passes: over the image; 0 gives the input back.
        window: side, px, odd.
        step: largest random change of the inverse depth, relative.
        seed: of these changes.

    Returns:
        depth and correlation [H, W] float32. Pixels without depth may get their neighbours' plane.
    """
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    slope_x, slope_y = _slopes(inverse, known)
    planes = np.ascontiguousarray(np.stack([inverse, slope_x, slope_y], -1), np.float32)
    best = np.where(known, np.maximum(score, _NOTHING), _NOTHING).astype(np.float32)
    use = np.ascontiguousarray(usable, np.uint8)
    for number in range(passes):
        for colour in (0, 1):
            _half_pass(
                np.ascontiguousarray(gray, np.float32), use, stack, sizes, maps, planes, best,
                _STEPS, colour, window // 2, F(step), np.int64(seed * 1000 + number),
            )  # fmt: skip
    found = planes[..., 0] > 0
    result = np.where(found, 1 / np.where(found, planes[..., 0], 1), 0)
    return result.astype(np.float32), best


def _slopes(inverse: Array, known: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Differences of inverse depth per pixel in x and y, 0 where a neighbour is missing."""
    slopes = []
    for axis in (1, 0):
        before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
        both = known & np.roll(known, 1, axis) & np.roll(known, -1, axis)
        slope = np.where(both, 0.5 * (after - before), 0)
        # A step of more than 2 % is an edge, not a slope.
        slopes.append(np.where(np.abs(slope) < 0.02 * inverse, slope, 0).astype(np.float32))
    return slopes[0], slopes[1]


@helper
def _correlation(  # type: ignore[no-untyped-def]
    gray, use, stack, sizes, maps, x, y, w, slope_x, slope_y, radius
):
    """Mean correlation of the better half of the sources with the window on a plane."""
    height, width = gray.shape
    scores = np.empty(stack.shape[0], np.float32)
    for s in range(stack.shape[0]):
        m = maps[s]
        n, a, b, aa, bb, ab = F(0), F(0), F(0), F(0), F(0), F(0)
        for dy in range(-radius, radius + 1):
            v = y + dy
            if v < 0 or v >= height:
                continue
            for dx in range(-radius, radius + 1):
                u = x + dx
                if u < 0 or u >= width or use[v, u] == 0:
                    continue
                inverse = w + slope_x * F(dx) + slope_y * F(dy)
                pu, pv = F(u) + F(0.5), F(v) + F(0.5)
                z = m[6] * pu + m[7] * pv + m[8] + inverse * m[11]
                if z <= F(1e-6):
                    continue
                px = (m[0] * pu + m[1] * pv + m[2] + inverse * m[9]) / z - F(0.5)
                py = (m[3] * pu + m[4] * pv + m[5] + inverse * m[10]) / z - F(0.5)
                if px < F(0) or py < F(0) or px >= sizes[s, 1] - F(1) or py >= sizes[s, 0] - F(1):
                    continue
                i, j = int(py), int(px)
                fx, fy = px - F(j), py - F(i)
                seen = (F(1) - fy) * (
                    (F(1) - fx) * stack[s, i, j] + fx * stack[s, i, j + 1]
                ) + fy * ((F(1) - fx) * stack[s, i + 1, j] + fx * stack[s, i + 1, j + 1])
                if seen < F(0):  # an unusable pixel has a share in it
                    continue
                here = gray[v, u]
                n += F(1)
                a += here
                b += seen
                aa += here * here
                bb += seen * seen
                ab += here * seen
        side = F(2 * radius + 1)
        if n < F(0.6) * side * side:
            scores[s] = _NOTHING
            continue
        va, vb = aa - a * a / n, bb - b * b / n
        if va <= F(1e-6) * n or vb <= F(1e-6) * n:
            scores[s] = F(0)
        else:
            scores[s] = (ab - a * b / n) / math.sqrt(va * vb)
    scores.sort()
    half = (len(scores) + 1) // 2
    total = F(0)
    for k in range(half):
        total += scores[len(scores) - 1 - k]
    return total / F(half)


@helper
def _noise(x, y, number, which):  # type: ignore[no-untyped-def]
    """A number in -1..1 that depends on its arguments alone (splitmix64)."""
    z = np.uint64(x * 73856093 + y * 19349663 + number * 83492791 + which * 2654435761)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return F(2) * F(z >> np.uint64(40)) / F(1 << 24) - F(1)


@kernel(parallel=True)
def _half_pass(  # type: ignore[no-untyped-def]
    gray, use, stack, sizes, maps, planes, best, steps, colour, radius, step, number
):
    """All pixels of one colour of the chequerboard; they read only the other colour's planes."""
    height, width = gray.shape
    for y in prange(height):
        for x in range((y + colour) % 2, width, 2):
            if use[y, x] == 0:
                continue
            w, sx, sy = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
            top = best[y, x]
            if w > F(0):  # judged again, with the slanted window
                top = _correlation(gray, use, stack, sizes, maps, x, y, w, sx, sy, radius)
            for k in range(steps.shape[0]):
                i, j = y + steps[k, 0], x + steps[k, 1]
                if i < 0 or j < 0 or i >= height or j >= width or planes[i, j, 0] <= F(0):
                    continue
                tx, ty = planes[i, j, 1], planes[i, j, 2]
                there = planes[i, j, 0] - tx * F(steps[k, 1]) - ty * F(steps[k, 0])
                if there <= F(0):
                    continue
                found = _correlation(gray, use, stack, sizes, maps, x, y, there, tx, ty, radius)
                if found > top:
                    w, sx, sy, top = there, tx, ty, found
            reach = step
            for k in range(_CHANGES):
                if w <= F(0):
                    break
                changed = w * (F(1) + reach * _noise(x, y, number, 3 * k))
                tx = sx + F(0.2) * reach * w * _noise(x, y, number, 3 * k + 1)
                ty = sy + F(0.2) * reach * w * _noise(x, y, number, 3 * k + 2)
                found = _correlation(gray, use, stack, sizes, maps, x, y, changed, tx, ty, radius)
                if found > top:
                    w, sx, sy, top = changed, tx, ty, found
                reach *= F(0.5)
            planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, sx, sy
            best[y, x] = top
