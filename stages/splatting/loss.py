"""Colour loss (1 - lambda) L1 + lambda (1 - SSIM) with its gradient, fused, as numba kernels.

SSIM as in 3DGS: Gaussian window 11x11, sigma 1.5, c1 = .01^2, c2 = .03^2. Pixels outside the mask
(and outside the image) are zero in both images, take no part in the mean, and get no gradient; the
means are over the valid pixels and the three channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from stages.splatting.lane_types import WIDTH as LANES
from stages.splatting.lanes import load_from, store_from
from stages.splatting.threads import KERNELS

Floats = npt.NDArray[np.float32]
F = np.float32
HALF = 5
TAPS = 2 * HALF + 1
_window = np.exp(-((np.arange(TAPS) - HALF) ** 2) / (2 * 1.5**2))
WINDOW = (_window / _window.sum()).astype(np.float32)
C1, C2 = F(0.01**2), F(0.03**2)
#: rows of a strip: the unit of parallel work
STRIP = 32


@njit(inline="always", error_model="numpy")
def _blur(source, start, step, target, to, wide):  # type: ignore[no-untyped-def]
    """Window over items `step` apart of `source`, from `start` on: `wide` results at `to`.

    Sums stay in a register; the plain loop over an array stores and loads them at every tap.
    """
    for x in range(0, wide, LANES):
        total = load_from(source, start + x) * WINDOW[0]
        for k in range(1, TAPS):
            total += load_from(source, start + x + k * step) * WINDOW[k]
        store_from(target, to + x, total)


@njit(parallel=True, cache=True, fastmath=True, error_model="numpy")
def ssim_forward(  # type: ignore[no-untyped-def]
    image: Floats, target: Floats, mask: Floats, target_mean: Floats, target_square: Floats,
    known: int, d_mean: Floats, d_square: Floats, d_product: Floats, sums: npt.NDArray[np.float64],
):  # fmt: skip
    """SSIM and L1 sums per strip and channel, and the derivatives of SSIM by the window's moments.

    Args:
        image: [>= 3, H, W], target: [3, H, W], mask: [H, W] 0 or 1.
        target_mean, target_square: [3, H, W] windowed moments of the target: read if `known`,
            else computed and stored.
        d_mean, d_square, d_product: [3, H, W] outputs: derivatives by E[x], E[x^2], E[x y].
        sums: [3 * strips, 3] output: sum of SSIM, of |x - y|, of (x - y)^2 over valid pixels.
    """
    height, width = mask.shape
    strips = (height + STRIP - 1) // STRIP
    for job in prange(3 * strips):
        channel = job // strips
        y0 = (job % strips) * STRIP
        y1 = min(height, y0 + STRIP)
        rows = y1 - y0 + 2 * HALF
        wide = (width + LANES - 1) // LANES * LANES
        across = np.zeros((5, STRIP + 2 * HALF, wide), np.float32)
        padded = np.zeros((5, wide + LANES), np.float32)
        maps = 3 if known == 1 else 5
        for row in range(rows):
            y = y0 - HALF + row
            if y < 0 or y >= height:
                continue
            for x in range(width):
                m = mask[y, x]
                p, t = image[channel, y, x] * m, target[channel, y, x] * m
                padded[0, x + HALF] = p
                padded[1, x + HALF] = p * p
                padded[2, x + HALF] = p * t
                padded[3, x + HALF] = t
                padded[4, x + HALF] = t * t
            for j in range(maps):
                _blur(
                    padded, j * (wide + LANES), 1,
                    across, (j * (STRIP + 2 * HALF) + row) * wide, wide,
                )  # fmt: skip
        moments = np.zeros((5, wide), np.float32)
        sums[job, 0] = sums[job, 1] = sums[job, 2] = 0.0
        for row in range(y1 - y0):
            y = y0 + row
            for j in range(maps):
                _blur(across, (j * (STRIP + 2 * HALF) + row) * wide, wide, moments, j * wide, wide)
            if known == 1:
                for x in range(width):
                    moments[3, x] = target_mean[channel, y, x]
                    moments[4, x] = target_square[channel, y, x]
            else:
                for x in range(width):
                    target_mean[channel, y, x] = moments[3, x]
                    target_square[channel, y, x] = moments[4, x]
            row_ssim, row_l1, row_square = F(0), F(0), F(0)
            for x in range(width):
                m = mask[y, x]
                m1, m2 = moments[0, x], moments[3, x]
                v1, v2 = moments[1, x] - m1 * m1, moments[4, x] - m2 * m2
                covariance = moments[2, x] - m1 * m2
                inverse_a = F(1) / (m1 * m1 + m2 * m2 + C1)
                inverse_b = F(1) / (v1 + v2 + C2)
                c = F(2) * m1 * m2 + C1
                d = F(2) * covariance + C2
                ssim = c * d * inverse_a * inverse_b
                by_v1 = -ssim * inverse_b
                by_covariance = F(2) * c * inverse_a * inverse_b
                d_mean[channel, y, x] = m * (
                    F(2) * m2 * d * inverse_a * inverse_b
                    - F(2) * m1 * ssim * inverse_a
                    - F(2) * m1 * by_v1
                    - m2 * by_covariance
                )
                d_square[channel, y, x] = m * by_v1
                d_product[channel, y, x] = m * by_covariance
                error = image[channel, y, x] - target[channel, y, x]
                row_ssim += m * ssim
                row_l1 += m * abs(error)
                row_square += m * error * error
            sums[job, 0] += row_ssim
            sums[job, 1] += row_l1
            sums[job, 2] += row_square


@njit(parallel=True, cache=True, fastmath=True, error_model="numpy")
def ssim_backward(  # type: ignore[no-untyped-def]
    image: Floats, target: Floats, mask: Floats, d_mean: Floats, d_square: Floats,
    d_product: Floats, l1_weight: np.float32, ssim_weight: np.float32, d_image: Floats,
):  # fmt: skip
    """Gradient of l1_weight * sum|x - y| - ssim_weight * sum(SSIM) into `d_image` [>= 3, H, W]."""
    height, width = mask.shape
    strips = (height + STRIP - 1) // STRIP
    for job in prange(3 * strips):
        channel = job // strips
        y0 = (job % strips) * STRIP
        y1 = min(height, y0 + STRIP)
        rows = y1 - y0 + 2 * HALF
        wide = (width + LANES - 1) // LANES * LANES
        across = np.zeros((3, STRIP + 2 * HALF, wide), np.float32)
        padded = np.zeros((3, wide + LANES), np.float32)
        moments = np.zeros((3, wide), np.float32)
        for row in range(rows):
            y = y0 - HALF + row
            if y < 0 or y >= height:
                continue
            for x in range(width):
                padded[0, x + HALF] = d_mean[channel, y, x]
                padded[1, x + HALF] = d_square[channel, y, x]
                padded[2, x + HALF] = d_product[channel, y, x]
            for j in range(3):
                _blur(
                    padded, j * (wide + LANES), 1,
                    across, (j * (STRIP + 2 * HALF) + row) * wide, wide,
                )  # fmt: skip
        for row in range(y1 - y0):
            y = y0 + row
            for j in range(3):
                _blur(across, (j * (STRIP + 2 * HALF) + row) * wide, wide, moments, j * wide, wide)
            for x in range(width):
                p, t = image[channel, y, x], target[channel, y, x]
                sign = F(1) if p > t else (F(-1) if p < t else F(0))
                d_image[channel, y, x] = mask[y, x] * (
                    l1_weight * sign
                    - ssim_weight * (moments[0, x] + F(2) * p * moments[1, x] + t * moments[2, x])
                )


@dataclass
class ColourLoss:
    """(1 - lambda) L1 + lambda (1 - SSIM) against one target image.

    Attributes:
        target: [3, H, W] float32.
        mask: [H, W] float32, 1 where the pixel counts.
    """

    target: Floats
    mask: Floats
    valid: float = field(init=False)
    _moments: tuple[Floats, Floats] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.valid = max(float(self.mask.sum(dtype=np.float64)), 1.0)

    def __call__(self, image: Floats, lambda_dssim: float) -> ColourLossResult:
        """Loss, its gradient, PSNR and SSIM for an image [>= 3, H, W]."""
        with KERNELS:
            return self._compare(image, lambda_dssim)

    def _compare(self, image: Floats, lambda_dssim: float) -> ColourLossResult:
        height = self.mask.shape[0]
        known = self._moments is not None
        if self._moments is None:
            self._moments = (np.empty_like(self.target), np.empty_like(self.target))
        by_mean, by_square, by_product = (np.empty_like(self.target) for _ in range(3))
        strips = -(-height // STRIP)
        sums = np.empty((3 * strips, 3))
        ssim_forward(
            image, self.target, self.mask, *self._moments, int(known),
            by_mean, by_square, by_product, sums,
        )  # fmt: skip
        count = 3 * self.valid
        # the strips' sums in a fixed order
        ssim, l1, square = (float(sums[:, k].sum()) / count for k in range(3))
        gradient = np.empty_like(self.target)
        ssim_backward(
            image, self.target, self.mask, by_mean, by_square, by_product,
            F((1 - lambda_dssim) / count), F(lambda_dssim / count), gradient,
        )  # fmt: skip
        loss = (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim)
        psnr = float(-10 * np.log10(max(square, 1e-12)))
        return ColourLossResult(loss, gradient, psnr, ssim)


@dataclass(frozen=True)
class ColourLossResult:
    """Attributes: loss; gradient [3, H, W]; psnr in dB; ssim (mean over valid pixels)."""

    loss: float
    gradient: Floats
    psnr: float
    ssim: float
