"""The colour behind everything, found with the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from stages.splatting.threads import KERNELS

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


@njit(parallel=True, cache=True, error_model="numpy")
def _lay_over(  # type: ignore[no-untyped-def]
    image: Floats, transmittance: Floats, colour: Floats, result: Floats
):
    channels, height, width = image.shape
    for row in prange(channels * height):
        channel, y = row // height, row % height
        behind = colour[channel]
        for x in range(width):
            result[channel, y, x] = image[channel, y, x] + transmittance[y, x] * behind


@njit(parallel=True, cache=True, error_model="numpy")
def _pull_back(  # type: ignore[no-untyped-def]
    d_image: Floats, transmittance: Floats, colour: Floats, d_transmittance: Floats, sums: Array
):
    """Gradients of `_lay_over`: of the transmittance (added to), of the colour in `sums` [H, 3]."""
    height, width = transmittance.shape
    for y in prange(height):
        red, green, blue = 0.0, 0.0, 0.0
        for x in range(width):
            left = transmittance[y, x]
            r, g, b = d_image[0, y, x], d_image[1, y, x], d_image[2, y, x]
            red += r * left
            green += g * left
            blue += b * left
            d_transmittance[y, x] += r * colour[0] + g * colour[1] + b * colour[2]
        sums[y, 0] = red
        sums[y, 1] = green
        sums[y, 2] = blue


class Background:
    """One sRGB colour, and Adam on it.

    Attributes:
        values: [3] float64 in 0..1.
        learned: whether it is found by the fit, or given; rate: of learning.
    """

    def __init__(self, values: Sequence[float], learned: bool, rate: float) -> None:
        self.values = np.array(values, np.float64)
        self.learned = learned
        self.rate = rate
        self.moments = np.zeros((2, 3))
        self.steps = 0

    def behind(self, image: Floats, transmittance: Floats) -> Floats:
        """[3, H, W] an image laid over the background through what it lets pass, [H, W]."""
        if not self.values.any():
            return image
        result = np.empty(image.shape, np.float32)
        with KERNELS:
            _lay_over(image, transmittance, self.values.astype(np.float32), result)
        return result

    def step(
        self, d_image: Floats, transmittance: Floats, d_transmittance: Floats | None = None
    ) -> None:
        """Move the colour against the gradient [3, H, W] of an image laid over it.

        What that gradient says of the transmittance is added to `d_transmittance` [H, W].
        """
        if not (self.learned or self.values.any()):
            return
        sums = np.empty((len(transmittance), 3))
        if d_transmittance is None:
            d_transmittance = np.zeros_like(transmittance)
        with KERNELS:
            _pull_back(
                d_image, transmittance, self.values.astype(np.float32), d_transmittance, sums
            )
        if not self.learned:
            return
        gradient = sums.sum(0)
        self.steps += 1
        self.moments[0] = 0.9 * self.moments[0] + 0.1 * gradient
        self.moments[1] = 0.99 * self.moments[1] + 0.01 * gradient**2
        mean = self.moments[0] / (1 - 0.9**self.steps)
        spread = np.sqrt(self.moments[1] / (1 - 0.99**self.steps))
        self.values = np.clip(self.values - self.rate * mean / (spread + 1e-15), 0, 1)
