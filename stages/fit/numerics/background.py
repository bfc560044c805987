"""An image laid over the colour that is behind everything, and the gradients of that."""

from __future__ import annotations

import numpy as np
from numba import prange

from pipeline.kernels import kernel
from stages.fit.arrays import Array, Floats
from stages.splatting.threads import KERNELS


@kernel(parallel=True)
def _lay_over(  # type: ignore[no-untyped-def]
    image: Floats, transmittance: Floats, colour: Floats, result: Floats
):
    channels, height, width = image.shape
    for row in prange(channels * height):
        channel, y = row // height, row % height
        behind = colour[channel]
        for x in range(width):
            result[channel, y, x] = image[channel, y, x] + transmittance[y, x] * behind


@kernel(parallel=True)
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


def behind(image: Floats, transmittance: Floats, colour: Array) -> Floats:
    """[3, H, W] an image laid over a colour [3] through what it lets pass, [H, W]."""
    result = np.empty(image.shape, np.float32)
    with KERNELS:
        _lay_over(image, transmittance, colour.astype(np.float32), result)
    return result


def pulled_back(
    d_image: Floats, transmittance: Floats, colour: Array, d_transmittance: Floats
) -> Array:
    """[3] gradient of the colour; that of the transmittance is added to `d_transmittance`."""
    sums = np.empty((len(transmittance), 3))
    with KERNELS:
        _pull_back(d_image, transmittance, colour.astype(np.float32), d_transmittance, sums)
    return np.asarray(sums.sum(0))
