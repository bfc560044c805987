"""Colour loss (1 - lambda) L1 + lambda (1 - SSIM) with its gradient.

Pixels outside the mask (and outside the image) are zero in both images, take no part in the mean,
and get no gradient; the means are over the valid pixels and the three channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from stages.splatting.kernels.ssim import COLUMNS, STRIP, ssim_backward, ssim_forward
from stages.splatting.threads import KERNELS, workers

Floats = npt.NDArray[np.float32]
F = np.float32
#: brighter than any target
MOST = 1e30


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

    def __call__(
        self, image: Floats, lambda_dssim: float, saturation: float = np.inf
    ) -> ColourLossResult:
        """Loss, its gradient, PSNR and SSIM for an image [>= 3, H, W].

        What a camera clips may be brighter: where the target reaches `saturation` and the image is
        brighter still, there is no error and no gradient.
        """
        with KERNELS:
            return self._compare(image, lambda_dssim, F(min(saturation, MOST)))

    def _compare(
        self, image: Floats, lambda_dssim: float, saturation: np.float32
    ) -> ColourLossResult:
        known = self._moments is not None
        if self._moments is None:
            self._moments = (np.empty_like(self.target), np.empty_like(self.target))
        by_mean, by_square, by_product = (np.empty_like(self.target) for _ in range(3))
        height, width = self.mask.shape
        totals = np.empty((3 * -(-height // STRIP) * -(-width // COLUMNS), 3))
        ssim_forward(
            workers(), image, self.target, self.mask[None], *self._moments, saturation, int(known),
            by_mean, by_square, by_product, totals,
        )  # fmt: skip
        count = 3 * self.valid
        # the strips' sums in a fixed order
        ssim, l1, square = (float(totals[:, k].sum()) / count for k in range(3))
        gradient = np.empty_like(self.target)
        ssim_backward(
            workers(), image, self.target, self.mask[None], saturation, by_mean, by_square,
            by_product, F((1 - lambda_dssim) / count), F(lambda_dssim / count), gradient,
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
