"""What is behind everything: an image laid over its colour, the gradients of that, and where
photographs show it (and where points were measured all the same)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import prange
from scipy.spatial import cKDTree

from pipeline.kernels import kernel
from stages.fit.arrays import Array, Bools, Floats
from stages.splatting.threads import KERNELS, workers

#: a photograph looks like the background where, blurred by so many pixels of one 512 wide, no
#: channel is off by more. With final_prune_empty at .8, unseen views of five triples of scan video
#: whose cameras features found gain .23 dB, of four wide ones with exact cameras .29, and the input
#: views lose .2; 3/255 and .8: .03; 12/255 and .6: .3 and .4, but input views lose .5. From six
#: views on nothing is gained (twelve: -.07).
UNSEEN, NOISE_PX = 8 / 255, 1.5
#: what lies within so many spacings of a point that was measured is something, however dark
MEASURED_REACH = 2.0
#: so many points tell the spacing
SAMPLED = 5000


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


def looks_like(photograph: Floats, background: Floats, scale: float) -> Floats:
    """[H, W] float32, 1 where a photograph [3, H, W] looks like the background [3, H, W].

    Args:
        scale: of its pixels, in pixels of a picture 512 wide.
    """
    off = [
        np.abs(cv2.GaussianBlur(channel, (0, 0), NOISE_PX * scale) - behind)
        for channel, behind in zip(photograph, background, strict=True)
    ]
    return np.asarray(np.max(off, axis=0) < UNSEEN, np.float32)


def near_measured(positions: Floats, measured: Array) -> Bools:
    """[N] which of some positions [N, 3] lie where points [M, 3] were measured, in one frame."""
    if not len(positions) or len(measured) < 2:
        return np.zeros(len(positions), bool)
    tree = cKDTree(measured)
    some = measured[:: max(1, len(measured) // SAMPLED)]
    reach = MEASURED_REACH * np.median(tree.query(some, 2, workers=workers())[0][:, 1])
    away, _ = tree.query(positions, distance_upper_bound=reach, workers=workers())
    return np.asarray(np.isfinite(away))
