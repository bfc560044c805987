"""Plane sweep: how well each pixel matches the other views at each depth hypothesis.

For fronto-parallel planes of the reference view, uniform in inverse depth, the sources are warped
onto the reference and compared by zero-mean normalised cross-correlation (ZNCC) over a square
window (Collins, "A space-sweep approach to true multi-image matching", CVPR 1996).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import each, helper, kernel
from stages.stereo.consistency import stacked
from stages.stereo.tiles import TILE, Buffer, Volume, full_ranges, tile_grid

Array = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]

#: Value of a source pixel that must not be used: so low that any share of it in a bilinear sample
#: makes the sample negative.
UNUSABLE = np.float32(-1e6)
#: Cost where nothing can be compared: that of no correlation, so that it prefers no depth.
NEUTRAL_COST = np.float32(1.0)
#: Cost of a source that can't be compared: above all that can (1.2).
_UNSEEN = np.float32(2)
#: Least grey variance in the denominator, so that noise does not correlate.
_LEAST_VARIANCE = np.float32(2e-5)
_ROWS, _COLUMNS = TILE


def plane_homographies(
    reference: Camera, sources: list[Camera], inverse_depths: npt.NDArray[np.float64]
) -> Array:
    """Homographies from reference pixels to source pixels by way of each plane z = 1/w.

    Args:
        reference: the view to sweep.
        sources: the views to compare with, S of them.
        inverse_depths: [D] inverse z-depth of the planes.

    Returns:
        [D, S, 9] float32, row-major 3x3, normalised to a largest entry of 1.
    """
    inverse_matrix = np.linalg.inv(reference.matrix)
    result = np.empty((len(inverse_depths), len(sources), 9), np.float64)
    for s, source in enumerate(sources):
        relative = source.cam_from_world @ np.linalg.inv(reference.cam_from_world)
        rotation = source.matrix @ relative[:3, :3] @ inverse_matrix
        # On the plane z = 1/w the translation enters as t * w * (0, 0, 1) . ray.
        shift = np.outer(source.matrix @ relative[:3, 3], inverse_matrix[2])
        result[:, s] = (rotation[None] + inverse_depths[:, None, None] * shift).reshape(-1, 9)
    result /= np.abs(result).max(axis=2, keepdims=True)
    return result.astype(np.float32)


def stack_sources(images: list[Array], usable: list[npt.NDArray[np.bool_]]) -> tuple[Array, Array]:
    """Stack images of different size into one array, unusable pixels marked.

    Args:
        images: S arrays [H_s, W_s] float32 grey.
        usable: S arrays [H_s, W_s] bool.

    Returns:
        [S, H, W] float32 with `UNUSABLE` outside each image and where not usable, and
        [S, 2] float32 (height, width) of each.
    """
    marked = [np.where(use, image, UNUSABLE) for image, use in zip(images, usable, strict=True)]
    return stacked(marked, UNUSABLE), np.array([image.shape for image in images], np.float32)


@helper(fastmath=True)
def _warp(source, height, width, h, xs, ys, where, across, down, inside, out):  # type: ignore[no-untyped-def]
    """Sample a source [H, W] bilinearly where the reference pixels (xs, ys) are seen in it.

    In two loops, as one would not be vectorised: `where` gets the index of the pixel up left of
    each sample, `across` and `down` how far beyond it the sample lies, `inside` >= 0 if it is one.
    """
    half = np.float32(0.5)
    one = np.float32(1)
    zero = np.float32(0)
    bottom = height - np.float32(2)
    right = width - np.float32(2)
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]
    stride = np.int32(source.shape[1])
    for k in range(out.shape[0]):
        x = xs[k]
        y = ys[k]
        depth = h6 * x + h7 * y + h8
        inverse = one / depth
        u = (h0 * x + h1 * y + h2) * inverse - half
        v = (h3 * x + h4 * y + h5) * inverse - half
        inside[k] = min(min(u, right - u), min(min(v, bottom - v), depth))
        u = min(max(u, zero), right)
        v = min(max(v, zero), bottom)
        i = np.int32(v)
        j = np.int32(u)
        across[k] = u - np.float32(j)
        down[k] = v - np.float32(i)
        where[k] = i * stride + j
    flat = source.reshape(-1)
    for k in range(out.shape[0]):
        at = np.uint64(where[k])  # unsigned: a signed index is asked whether it counts from the end
        under = at + np.uint64(stride)
        top = flat[at] + (flat[at + np.uint64(1)] - flat[at]) * across[k]
        low = flat[under] + (flat[under + np.uint64(1)] - flat[under]) * across[k]
        out[k] = top + (low - top) * down[k] if inside[k] >= zero else UNUSABLE


@helper(fastmath=True)
def _window_sums(values, window, stride, length, rows, out):  # type: ignore[no-untyped-def]
    """Sums over square windows of an image that is stored row by row, `stride` apart.

    Windows begin at each of the first `length` pixels; what begins at a row's end is of no use.
    """
    reach = length + (window - 1) * stride
    for k in range(reach):
        rows[k] = values[k]
    for step in range(1, window):
        for k in range(reach):
            rows[k] += values[k + step]
    for k in range(length):
        out[k] = rows[k]
    for step in range(1, window):
        below = rows[step * stride :]
        for k in range(length):
            out[k] += below[k]


@kernel(fastmath=True, nogil=True)
def _sweep_tile(  # type: ignore[no-untyped-def]
    tile,
    across,
    reference,
    weight,
    sources,
    sizes,
    homographies,
    radius,
    var_min,
    starts,
    ranges,
    costs,
):
    """Fill a tile of the cost volume, at the planes of its range."""
    height, width = reference.shape
    first, planes = ranges[tile, 0], ranges[tile, 1] - ranges[tile, 0]
    y0 = tile // across * _ROWS
    x0 = tile % across * _COLUMNS
    window = 2 * radius + 1
    stride = _COLUMNS + 2 * radius
    size = (_ROWS + 2 * radius) * stride
    length = _ROWS * stride
    half = np.float32(0.5)
    one = np.float32(1)
    zero = np.float32(0)
    xs = np.empty(size, np.float32)
    ys = np.empty(size, np.float32)
    grey = np.empty(size, np.float32)
    mask = np.empty(size, np.float32)
    for k in range(size):
        y = y0 - radius + k // stride
        x = x0 - radius + k % stride
        xs[k] = np.float32(x) + half
        ys[k] = np.float32(y) + half
        within = 0 <= y < height and 0 <= x < width
        grey[k] = reference[y, x] - half if within else zero
        mask[k] = weight[y, x] if within else zero
    # Room beyond the end: windows that begin at a row's end read over it.
    values = np.zeros((3, size + window), np.float32)
    rows = np.empty(size, np.float32)
    warped = np.empty(size, np.float32)
    where = np.empty(size, np.int32)
    across_px = np.empty(size, np.float32)
    down_px = np.empty(size, np.float32)
    inside = np.empty(size, np.float32)
    own = np.empty((3, length), np.float32)  # sums of 1, i, i i over what the reference can use
    part = np.empty((3, length), np.float32)  # the same over what the source shows too
    sums = np.empty((3, length), np.float32)  # of w, w w, i w
    best = np.empty(length, np.float32)
    next_best = np.empty(length, np.float32)
    seen = np.empty(length, np.float32)
    for k in range(size):
        values[0, k] = mask[k]
        values[1, k] = mask[k] * grey[k]
        values[2, k] = mask[k] * grey[k] * grey[k]
    for q in range(3):
        _window_sums(values[q], window, stride, length, rows, own[q])
    enough = half * np.float32(window * window)
    for d in range(first, first + planes):
        for k in range(length):
            best[k] = _UNSEEN
            next_best[k] = _UNSEEN
            seen[k] = zero
        for s in range(sources.shape[0]):
            _warp(
                sources[s], sizes[s, 0], sizes[s, 1], homographies[d, s], xs, ys,
                where, across_px, down_px, inside, warped,
            )  # fmt: skip
            hidden = zero
            for k in range(size):
                m = mask[k] if warped[k] >= zero else zero
                w = m * (warped[k] - half)
                hidden += mask[k] - m
                values[0, k] = w
                values[1, k] = w * w
                values[2, k] = w * grey[k]
            for q in range(3):
                _window_sums(values[q], window, stride, length, rows, sums[q])
            of = own
            if hidden > zero:
                of = part
                for k in range(size):
                    m = mask[k] if warped[k] >= zero else zero
                    values[0, k] = m
                    values[1, k] = m * grey[k]
                    values[2, k] = m * grey[k] * grey[k]
                for q in range(3):
                    _window_sums(values[q], window, stride, length, rows, part[q])
            count, of_i, of_ii = of[0], of[1], of[2]
            of_w, of_ww, of_iw = sums[0], sums[1], sums[2]
            for k in range(length):
                share = one / max(count[k], one)
                mean_i = of_i[k] * share
                mean_w = of_w[k] * share
                var_i = max(of_ii[k] * share - mean_i * mean_i, var_min)
                var_w = max(of_ww[k] * share - mean_w * mean_w, var_min)
                covariance = of_iw[k] * share - mean_i * mean_w
                cost = min(max(one - covariance / np.sqrt(var_i * var_w), zero), np.float32(1.2))
                known = count[k] >= enough
                cost = cost if known else _UNSEEN
                seen[k] += one if known else zero
                next_best[k] = min(next_best[k], max(best[k], cost))
                best[k] = min(best[k], cost)
        # The better half of the sources that see the pixel, two at most: what is hidden in some
        # views is judged by the others.
        for k in range(length):
            cost = half * (best[k] + next_best[k]) if seen[k] >= np.float32(3) else best[k]
            best[k] = cost if seen[k] > zero else NEUTRAL_COST
        at = starts[tile] + d - first
        for y in range(min(_ROWS, height - y0)):
            for x in range(min(_COLUMNS, width - x0)):
                costs[at + (y * _COLUMNS + x) * planes] = best[y * stride + x]


def cost_volume(
    reference: Array,
    usable: npt.NDArray[np.bool_],
    sources: Array,
    sizes: Array,
    homographies: Array,
    window: int,
    ranges: Integers | None = None,
    buffer: Buffer | None = None,
) -> Volume:
    """Matching cost of every pixel at every plane: 1 - ZNCC, averaged over the best sources.

    The best two count, or of less than three that see the pixel the best. Only pixels that are
    usable in both views enter a window; a window with less than half of its pixels compares
    nothing. Deterministic for any thread count: tiles are independent.

    Args:
        reference: [H, W] float32 grey in 0..1.
        usable: [H, W] bool.
        sources: [S, H_max, W_max] float32 with `UNUSABLE` pixels, from `stack_sources`.
        sizes: [S, 2] float32 (height, width) of each source.
        homographies: [D, S, 9] float32 from `plane_homographies`.
        window: side of the window in pixels, odd.
        ranges: [T, 2] int64 for every tile (row by row) its first plane and the one after its
            last; None: all planes.
        buffer: where the volume goes; None: into memory of its own.

    Returns:
        Costs in 0..1.2; `NEUTRAL_COST` where no source can be compared.
    """
    height, width = reference.shape
    shape = height, width, len(homographies)
    down, across = tile_grid((height, width))
    ranges = full_ranges((height, width), len(homographies)) if ranges is None else ranges
    volume = Volume.over(ranges, shape, buffer)
    each(
        _sweep_tile, down * across, across, np.ascontiguousarray(reference, np.float32),
        usable.astype(np.float32), sources, sizes, homographies, int(window) // 2,
        _LEAST_VARIANCE, volume.starts, volume.ranges, volume.values,
    )  # fmt: skip
    return volume
