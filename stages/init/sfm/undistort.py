"""Radial lens distortion: pixels and images of a bent lens to those of a pinhole, and back.

COLMAP's SIMPLE_RADIAL: with n = (pixel - centre) / focal, what a pinhole has at n is seen at
n (1 + k1 |n|^2). The centre is the middle of the image.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Newton steps that invert the polynomial to machine precision for any lens that is sane.
_NEWTON_STEPS = 20


def distort_pixels(pixels: Array, focal: float, k1: float, size: tuple[int, int]) -> Array:
    """Where the lens shows what a pinhole with its focal length would show at these pixels.

    Args:
        pixels: [..., 2] of the undistorted image, centres at .5.
        focal: pixels.
        k1: radial coefficient.
        size: width and height of the image.

    Returns:
        [..., 2] pixels of the photograph.
    """
    centre = np.array(size, np.float64) / 2
    ray = (np.asarray(pixels, np.float64) - centre) / focal
    return np.asarray(
        centre + focal * ray * (1 + k1 * (ray**2).sum(-1, keepdims=True)), np.float64
    )  # fmt: skip


def undistort_pixels(pixels: Array, focal: float, k1: float, size: tuple[int, int]) -> Array:
    """The inverse of `distort_pixels`.

    Where a barrel so strong folds the image onto itself there is none: such pixels go to the fold.

    Args:
        pixels: [..., 2] of the photograph, centres at .5.
        focal: pixels.
        k1: radial coefficient.
        size: width and height of the image.

    Returns:
        [..., 2] pixels of the undistorted image.
    """
    centre = np.array(size, np.float64) / 2
    ray = (np.asarray(pixels, np.float64) - centre) / focal
    seen = np.linalg.norm(ray, axis=-1, keepdims=True)
    fold = np.inf if k1 >= 0 else 1 / np.sqrt(-3 * k1)
    radius = np.minimum(seen, fold)
    for _ in range(_NEWTON_STEPS):
        slope = np.maximum(1 + 3 * k1 * radius**2, 1e-6)
        radius = np.clip(radius - (radius * (1 + k1 * radius**2) - seen) / slope, 0, fold)
    growth = np.where(seen > 1e-12, radius / np.maximum(seen, 1e-12), 1.0)
    return np.asarray(centre + focal * ray * growth, np.float64)


def undistort_image(
    image: npt.NDArray[np.float32], valid: npt.NDArray[np.bool_], focal: float, k1: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """The image that a pinhole with this focal length would have taken.

    Args:
        image: [H, W, 3] or [H, W] float32 in 0..1.
        valid: [H, W] bool, where it may be used.
        focal: pixels, of the photograph and of the result.
        k1: radial coefficient; 0 gives the input back.

    Returns:
        The image, and where it may be used: not outside of what the photograph shows, nor where
        a pixel mixes in one that is not valid. Both of the input's size.
    """
    if k1 == 0:
        return image, valid
    height, width = valid.shape
    v, u = np.mgrid[:height, :width] + 0.5
    source = distort_pixels(np.stack([u, v], -1), focal, k1, (width, height)) - 0.5
    x, y = source[..., 0].astype(np.float32), source[..., 1].astype(np.float32)
    bent = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    share = cv2.remap(
        valid.astype(np.float32), x, y, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=0,
    )  # fmt: skip
    return np.clip(bent, 0, 1).astype(np.float32), np.asarray(share > 0.999)
