"""What the image itself says about a pixel: grey value, highlights; and normals from depth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Array = npt.NDArray[np.float32]


def to_gray(image: Array) -> Array:
    """Luma [H, W] float32 of an sRGB image [H, W, 3] float32."""
    return np.ascontiguousarray(image @ np.array([0.299, 0.587, 0.114], np.float32), np.float32)


def highlights(image: Array, level: float = 0.9, rise: float = 0.18, grow: int = 1) -> Array:
    """Specular highlights and saturated pixels: white, and brighter than what is around them.

    The least channel is high only where the surface mirrors the (white) light, whatever its own
    colour is.

    Args:
        image: [H, W, 3] float32 sRGB in 0..1.
        level: a least channel above this is a highlight by itself.
        rise: or one that exceeds its surroundings (median of 31x31) by this much and is over 0.5.
        grow: pixels to add around, where the highlight fades.

    Returns:
        [H, W] float32: 1 inside, 0 outside.
    """
    least = np.ascontiguousarray(image.min(axis=2))
    # A median of a reduced image: the full one is slow and no better.
    small = least[2::4, 2::4] if min(least.shape) > 8 else least
    around = ndimage.median_filter(small, size=9, mode="nearest")
    if small is not least:
        around = around.repeat(4, 0).repeat(4, 1)
        pad = [(0, max(0, n - m)) for n, m in zip(least.shape, around.shape, strict=True)]
        around = np.pad(around, pad, mode="edge")[: least.shape[0], : least.shape[1]]
    white = (least > level) | ((least - around > rise) & (least > 0.5))
    if grow:
        white = ndimage.binary_dilation(white, iterations=grow)
    return white.astype(np.float32)
