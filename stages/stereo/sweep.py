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

Array = npt.NDArray[np.float32]

#: Value of a source pixel that must not be used: so low that any share of it in a bilinear sample
#: makes the sample negative.
UNUSABLE = np.float32(-1e6)
#: Cost where nothing can be compared: that of no correlation, so that it prefers no depth.
NEUTRAL_COST = np.float32(1.0)
#: Rows that one task sweeps: its part of the cost volume stays in the cache.
_BAND = 16


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
    height = max(image.shape[0] for image in images)
    width = max(image.shape[1] for image in images)
    stack = np.full((len(images), height, width), UNUSABLE, np.float32)
    for s, (image, use) in enumerate(zip(images, usable, strict=True)):
        stack[s, : image.shape[0], : image.shape[1]] = np.where(use, image, UNUSABLE)
    return stack, np.array([image.shape for image in images], np.float32)


@helper(fastmath=True)
def _warp_row(source, height, width, h, y, x0, row):  # type: ignore[no-untyped-def]
    """Sample a source [H, W] bilinearly along reference row y, columns x0, x0 + 1, ..."""
    v0 = h[1] * y + h[2]
    v1 = h[4] * y + h[5]
    v2 = h[7] * y + h[8]
    half = np.float32(0.5)
    one = np.float32(1)
    bottom = height - np.float32(2)
    right = width - np.float32(2)
    for k in range(row.shape[0]):
        x = np.float32(x0 + k) + half
        depth = h[6] * x + v2
        inverse = one / depth
        u = (h[0] * x + v0) * inverse - half
        v = (h[3] * x + v1) * inverse - half
        inside = (depth > 0) & (u >= 0) & (v >= 0) & (u <= right) & (v <= bottom)
        u = min(max(u, np.float32(0)), right)
        v = min(max(v, np.float32(0)), bottom)
        i = np.int32(v)
        j = np.int32(u)
        a = v - np.float32(i)
        b = u - np.float32(j)
        top = source[i, j] * (one - b) + source[i, j + 1] * b
        low = source[i + 1, j] * (one - b) + source[i + 1, j + 1] * b
        row[k] = top * (one - a) + low * a if inside else UNUSABLE


@kernel(fastmath=True, nogil=True)
def _sweep_band(  # type: ignore[no-untyped-def]
    band, reference, weight, sources, sizes, homographies, radius, var_min, keep, volume
):
    """Fill a band of rows of the cost volume."""
    height, width = reference.shape
    y0 = band * _BAND
    y1 = min(y0 + _BAND, height)
    planes = homographies.shape[0]
    count = sources.shape[0]
    window = 2 * radius + 1
    rows = y1 - y0
    warped = np.empty(width + 2 * radius, np.float32)
    ref_row = np.empty(width + 2 * radius, np.float32)
    ref_weight = np.empty(width + 2 * radius, np.float32)
    products = np.empty((6, width + 2 * radius), np.float32)
    # Horizontal window sums of m, m I, m w, m I I, m w w, m I w for every row of the band.
    sums = np.empty((rows + 2 * radius, 6, width), np.float32)
    total = np.empty((6, width), np.float32)
    costs = np.empty((rows, count, width), np.float32)
    enough = np.float32(0.5 * window * window)
    one = np.float32(1)
    zero = np.float32(0)
    half = np.float32(0.5)
    for d in range(planes):
        for s in range(count):
            for r in range(rows + 2 * radius):
                y = min(max(y0 - radius + r, 0), height - 1)
                inside = 0 <= y0 - radius + r < height
                for k in range(radius):
                    ref_row[k] = zero
                    ref_weight[k] = zero
                    ref_row[width + radius + k] = zero
                    ref_weight[width + radius + k] = zero
                for x in range(width):
                    ref_row[radius + x] = reference[y, x] - half
                    ref_weight[radius + x] = weight[y, x] if inside else zero
                _warp_row(
                    sources[s], sizes[s, 0], sizes[s, 1], homographies[d, s],
                    np.float32(y) + half, -radius, warped,
                )  # fmt: skip
                for k in range(width + 2 * radius):
                    m = ref_weight[k] if warped[k] >= zero else zero
                    w = (warped[k] - half) if warped[k] >= zero else zero
                    i = ref_row[k]
                    products[0, k] = m
                    products[1, k] = m * i
                    products[2, k] = m * w
                    products[3, k] = m * i * i
                    products[4, k] = m * w * w
                    products[5, k] = m * i * w
                for q in range(6):
                    target = sums[r, q]
                    values = products[q]
                    for x in range(width):
                        target[x] = values[x]
                    for k in range(1, window):
                        for x in range(width):
                            target[x] += values[x + k]
            for r in range(rows):
                for q in range(6):
                    out = total[q]
                    for x in range(width):
                        out[x] = sums[r, q, x]
                    for k in range(1, window):
                        more = sums[r + k, q]
                        for x in range(width):
                            out[x] += more[x]
                cost_row = costs[r, s]
                for x in range(width):
                    n = max(total[0, x], one)
                    mean_i = total[1, x] / n
                    mean_w = total[2, x] / n
                    var_i = max(total[3, x] / n - mean_i * mean_i, var_min)
                    var_w = max(total[4, x] / n - mean_w * mean_w, var_min)
                    covariance = total[5, x] / n - mean_i * mean_w
                    cost = one - covariance / np.sqrt(var_i * var_w)
                    cost = min(max(cost, zero), np.float32(1.2))
                    cost_row[x] = cost if total[0, x] >= enough else np.float32(2)
        for r in range(rows):
            for x in range(width):
                # Mean of the best `keep` of the sources that see the pixel (at most half of them
                # plus one half, rounded up): what is hidden in some views is judged by the others.
                seen = 0
                for s in range(count):
                    if costs[r, s, x] < np.float32(1.5):
                        seen += 1
                if seen == 0:
                    volume[y0 + r, x, d] = NEUTRAL_COST
                    continue
                use = min((seen + 1) // 2, keep)
                mean = zero
                for _ in range(use):
                    best = 0
                    for s in range(1, count):
                        if costs[r, s, x] < costs[r, best, x]:
                            best = s
                    mean += costs[r, best, x]
                    costs[r, best, x] = np.float32(9)
                volume[y0 + r, x, d] = mean / np.float32(use)


def cost_volume(
    reference: Array,
    usable: npt.NDArray[np.bool_],
    sources: Array,
    sizes: Array,
    homographies: Array,
    window: int,
    var_min: float = 2e-5,
    keep: int = 2,
) -> Array:
    """Matching cost of every pixel at every plane: 1 - ZNCC, averaged over the best sources.

    Only pixels that are usable in both views enter a window; a window with less than half of its
    pixels compares nothing. Deterministic for any thread count: bands of rows are independent.

    Args:
        reference: [H, W] float32 grey in 0..1.
        usable: [H, W] bool.
        sources: [S, H_max, W_max] float32 with `UNUSABLE` pixels, from `stack_sources`.
        sizes: [S, 2] float32 (height, width) of each source.
        homographies: [D, S, 9] float32 from `plane_homographies`.
        window: side of the window in pixels, odd.
        var_min: least variance in the denominator, so that noise does not correlate.
        keep: at most this many of the best sources are averaged.

    Returns:
        [H, W, D] float32 in 0..1.2; `NEUTRAL_COST` where no source can be compared.
    """
    height, width = reference.shape
    volume = np.empty((height, width, len(homographies)), np.float32)
    each(
        _sweep_band, -(-height // _BAND), np.ascontiguousarray(reference, np.float32),
        usable.astype(np.float32), sources, sizes, homographies, int(window) // 2,
        np.float32(var_min), int(keep), volume,
    )  # fmt: skip
    return volume
