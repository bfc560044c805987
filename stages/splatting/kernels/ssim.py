"""SSIM and L1 of two images with their gradient, fused.

Gaussian window 11x11, sigma 1.5, c1 = .01^2, c2 = .03^2, as in 3DGS. Images are taken in strips of
rows; threads take the next strip as they are free: which thread does one changes nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, inlined, kernel
from stages.splatting.lanes.blocks import take_number
from stages.splatting.lanes.rows import load_part, store_part, windowed
from stages.splatting.lanes.types import WIDTH as LANES
from stages.splatting.lanes.vectors import (
    absolute,
    constant,
    load_from,
    spread,
    store_from,
    sums,
    where,
)

Floats = npt.NDArray[np.float32]
F = np.float32
HALF = 5
TAPS = 2 * HALF + 1
_window = np.exp(-((np.arange(TAPS) - HALF) ** 2) / (2 * 1.5**2))
WINDOW = (_window / _window.sum()).astype(np.float32)
C1, C2 = F(0.01**2), F(0.03**2)
#: rows of a strip: the unit of parallel work
STRIP = 32
#: columns of a strip: short pieces of rows come from memory half as fast
COLUMNS = 512
#: rows that a strip looks at, and columns, an odd number of vectors
ROWS, PITCH = STRIP + 2 * HALF, COLUMNS + LANES
#: numbers from one windowed map of a strip to the next
MAP = ROWS * PITCH


@inlined
def _weights():  # type: ignore[no-untyped-def]
    return (
        constant(WINDOW[0]), constant(WINDOW[1]), constant(WINDOW[2]), constant(WINDOW[3]),
        constant(WINDOW[4]), constant(WINDOW[5]),
    )  # fmt: skip


@inlined
def _down(across, at, weights):  # type: ignore[no-untyped-def]
    """Window over the column of vectors that begins at `at`.

    Written out: as a loop over the taps it takes twice as long.
    """
    w0, w1, w2, w3, w4, w5 = weights
    near = load_from(across, at + 5 * PITCH) * w5
    near += (load_from(across, at + 4 * PITCH) + load_from(across, at + 6 * PITCH)) * w4
    near += (load_from(across, at + 3 * PITCH) + load_from(across, at + 7 * PITCH)) * w3
    far = (load_from(across, at) + load_from(across, at + 10 * PITCH)) * w0
    far += (load_from(across, at + PITCH) + load_from(across, at + 9 * PITCH)) * w1
    far += (load_from(across, at + 2 * PITCH) + load_from(across, at + 8 * PITCH)) * w2
    return near + far


@inlined
def _clear(across, maps, row):  # type: ignore[no-untyped-def]
    for j in range(maps):
        for x in range(0, PITCH, LANES):
            store_from(across, (j * ROWS + row) * PITCH + x, spread(F(0)))


@inlined
def _place(job, height, width):  # type: ignore[no-untyped-def]
    """A job's channel, first row, row after the last, first column, and width in whole vectors."""
    across = (width + COLUMNS - 1) // COLUMNS
    strips = (height + STRIP - 1) // STRIP
    y0, x0 = job // across % strips * STRIP, job % across * COLUMNS
    wide = min(COLUMNS, (width - x0 + LANES - 1) // LANES * LANES)
    return job // across // strips, y0, min(height, y0 + STRIP), x0, wide


@inlined
def _jobs(height, width):  # type: ignore[no-untyped-def]
    return 3 * ((height + STRIP - 1) // STRIP) * ((width + COLUMNS - 1) // COLUMNS)


@helper
def _forward_strip(  # type: ignore[no-untyped-def]
    job, image, target, mask, target_mean, target_square, saturation, known, d_mean, d_square,
    d_product, totals, across, parts,
):  # fmt: skip
    """One strip of one channel; `across` and `parts` are scratch."""
    height, width = mask.shape[1], mask.shape[2]
    channel, y0, y1, x0, wide = _place(job, height, width)
    weights = _weights()
    maps = 3 if known == 1 else 5
    for row in range(y1 - y0 + 2 * HALF):
        y = y0 - HALF + row
        if y < 0 or y >= height:
            _clear(across, maps, row)
            continue
        base = (channel * height + y) * width
        p1 = t1 = spread(F(0))
        for x in range(-LANES, wide, LANES):
            # the vector at hand and the one after it
            p0, t0 = p1, t1
            u = x + LANES + x0 - HALF
            p1 = load_part(image, base + u, -u, width - u)
            t1 = load_part(target, base + u, -u, width - u)
            m1 = load_part(mask, y * width + u, -u, width - u)
            p1 = where((t1 >= saturation) & (p1 > t1), t1, p1) * m1
            t1 = t1 * m1
            if x < 0:
                continue
            at = row * PITCH + x
            store_from(across, at, windowed(p0, p1, weights))
            store_from(across, MAP + at, windowed(p0 * p0, p1 * p1, weights))
            store_from(across, 2 * MAP + at, windowed(p0 * t0, p1 * t1, weights))
            if known == 0:
                store_from(across, 3 * MAP + at, windowed(t0, t1, weights))
                store_from(across, 4 * MAP + at, windowed(t0 * t0, t1 * t1, weights))
    total_ssim, total_l1, total_square = 0.0, 0.0, 0.0
    one, two, zero = spread(F(1)), F(2), spread(F(0))
    for row in range(y1 - y0):
        y = y0 + row
        base = (channel * height + y) * width
        sum_ssim = sum_l1 = sum_square = zero
        for x in range(0, wide, LANES):
            u = x + x0
            p = load_part(image, base + u, 0, width - u)
            t = load_part(target, base + u, 0, width - u)
            m = load_part(mask, y * width + u, 0, width - u)
            at = row * PITCH + x
            m1, mean_square = _down(across, at, weights), _down(across, MAP + at, weights)
            product = _down(across, 2 * MAP + at, weights)
            if known == 1:
                m2 = load_part(target_mean, base + u, 0, width - u)
                target_power = load_part(target_square, base + u, 0, width - u)
            else:
                m2 = _down(across, 3 * MAP + at, weights)
                target_power = _down(across, 4 * MAP + at, weights)
                store_part(target_mean, base + u, m2, width - u)
                store_part(target_square, base + u, target_power, width - u)
            m11, m22, m12 = m1 * m1, m2 * m2, m1 * m2
            v1, v2 = mean_square - m11, target_power - m22
            covariance = product - m12
            inverse_a, inverse_b = one / (m11 + m22 + C1), one / (v1 + v2 + C2)
            c, d = m12 * two + C1, covariance * two + C2
            both = inverse_a * inverse_b
            ssim = c * d * both
            by_v1 = zero - ssim * inverse_b
            by_covariance = c * both * two
            by_mean = (m2 * d * both - m1 * (ssim * inverse_a + by_v1)) * two - m2 * by_covariance
            store_part(d_mean, base + u, m * by_mean, width - u)
            store_part(d_square, base + u, m * by_v1, width - u)
            store_part(d_product, base + u, m * by_covariance, width - u)
            error = where((t >= saturation) & (p > t), zero, p - t)
            sum_ssim += m * ssim
            sum_l1 += m * absolute(error)
            sum_square += m * error * error
        z = zero
        store_from(
            parts, 0, sums((sum_ssim, sum_l1, sum_square, z, z, z, z, z, z, z, z, z, z, z, z, z))
        )
        total_ssim += parts[0]
        total_l1 += parts[1]
        total_square += parts[2]
    totals[job, 0] = total_ssim
    totals[job, 1] = total_l1
    totals[job, 2] = total_square


@kernel(parallel=True)
def ssim_forward(  # type: ignore[no-untyped-def]
    workers: int, image: Floats, target: Floats, mask: Floats, target_mean: Floats,
    target_square: Floats, saturation: np.float32, known: int, d_mean: Floats, d_square: Floats,
    d_product: Floats, totals: npt.NDArray[np.float64],
):  # fmt: skip
    """SSIM and L1 sums per strip and channel, and the derivatives of SSIM by the window's moments.

    Args:
        workers: number of threads.
        image: [>= 3, H, W], target: [3, H, W], mask: [1, H, W] 0 or 1.
        saturation: where the target reaches it, a brighter image has no error.
        target_mean, target_square: [3, H, W] windowed moments of the target: read if `known`,
            else computed and stored.
        d_mean, d_square, d_product: [3, H, W] outputs: derivatives by E[x], E[x^2], E[x y].
        totals: [jobs, 3] output: sum of SSIM, of |x - y|, of (x - y)^2 over valid pixels.
    """
    jobs = _jobs(mask.shape[1], mask.shape[2])
    taken = np.zeros(1, np.int64)
    for _ in prange(workers):
        across = np.zeros((5, ROWS, PITCH), np.float32)
        parts = np.zeros(LANES, np.float32)
        job = take_number(taken)
        while job < jobs:
            _forward_strip(
                job, image, target, mask, target_mean, target_square, saturation, known, d_mean,
                d_square, d_product, totals, across, parts,
            )  # fmt: skip
            job = take_number(taken)


@helper
def _backward_strip(  # type: ignore[no-untyped-def]
    job, image, target, mask, saturation, d_mean, d_square, d_product, l1_weight, ssim_weight,
    d_image, across,
):  # fmt: skip
    """One strip of one channel; `across` is scratch."""
    height, width = mask.shape[1], mask.shape[2]
    channel, y0, y1, x0, wide = _place(job, height, width)
    weights = _weights()
    for row in range(y1 - y0 + 2 * HALF):
        y = y0 - HALF + row
        if y < 0 or y >= height:
            _clear(across, 3, row)
            continue
        base = (channel * height + y) * width
        a1 = b1 = c1 = spread(F(0))
        for x in range(-LANES, wide, LANES):
            a0, b0, c0 = a1, b1, c1
            u = x + LANES + x0 - HALF
            a1 = load_part(d_mean, base + u, -u, width - u)
            b1 = load_part(d_square, base + u, -u, width - u)
            c1 = load_part(d_product, base + u, -u, width - u)
            if x < 0:
                continue
            at = row * PITCH + x
            store_from(across, at, windowed(a0, a1, weights))
            store_from(across, MAP + at, windowed(b0, b1, weights))
            store_from(across, 2 * MAP + at, windowed(c0, c1, weights))
    zero = spread(F(0))
    for row in range(y1 - y0):
        y = y0 + row
        base = (channel * height + y) * width
        for x in range(0, wide, LANES):
            u = x + x0
            p = load_part(image, base + u, 0, width - u)
            t = load_part(target, base + u, 0, width - u)
            m = load_part(mask, y * width + u, 0, width - u)
            at = row * PITCH + x
            counts = where((t >= saturation) & (p > t), zero, m)
            sign = where(p > t, spread(l1_weight), zero) - where(t > p, spread(l1_weight), zero)
            by_ssim = _down(across, at, weights) + p * _down(across, MAP + at, weights) * F(2)
            by_ssim += t * _down(across, 2 * MAP + at, weights)
            store_part(d_image, base + u, counts * (sign - by_ssim * ssim_weight), width - u)


@kernel(parallel=True)
def ssim_backward(  # type: ignore[no-untyped-def]
    workers: int, image: Floats, target: Floats, mask: Floats, saturation: np.float32,
    d_mean: Floats, d_square: Floats, d_product: Floats, l1_weight: np.float32,
    ssim_weight: np.float32, d_image: Floats,
):  # fmt: skip
    """Gradient of l1_weight * sum|x - y| - ssim_weight * sum(SSIM) into `d_image` [>= 3, H, W]."""
    jobs = _jobs(mask.shape[1], mask.shape[2])
    taken = np.zeros(1, np.int64)
    for _ in prange(workers):
        across = np.zeros((3, ROWS, PITCH), np.float32)
        job = take_number(taken)
        while job < jobs:
            _backward_strip(
                job, image, target, mask, saturation, d_mean, d_square, d_product, l1_weight,
                ssim_weight, d_image, across,
            )  # fmt: skip
            job = take_number(taken)
