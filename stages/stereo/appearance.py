"""What the image itself says about a pixel: grey value, highlights; and normals from depth."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts.cameras import Camera

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


def normals_from_depth(depth: Array, weight: Array, camera: Camera, sigma_px: float = 2.0) -> Array:
    """Surface normals from the slope of the smoothed inverse depth.

    On a plane n . X = c the inverse depth is n . ray / c: linear in the pixel coordinates, so its
    gradient is the normal.

    Args:
        depth: [H, W] float32 z-depth, 0 where there is none.
        weight: [H, W] float32 weight of each depth in the smoothing.
        camera: the view.
        sigma_px: of the Gaussian.

    Returns:
        [H, W, 3] float32 unit normals in the world, facing the camera; 0 where there is no depth.
    """
    known = depth > 0
    inverse = np.where(known, 1.0 / np.where(known, depth, 1), 0.0)
    trust = np.where(known, weight, 0.0)
    mass, smooth = blurred(trust, sigma_px), blurred(trust * inverse, sigma_px)
    smooth = np.where(mass > 1e-9, smooth / np.maximum(mass, 1e-9), inverse)
    gy, gx = np.gradient(smooth)
    height, width = depth.shape
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = ((np.arange(height) + 0.5 - camera.cy) / camera.fy)[:, None]
    # Plane by plane: several times faster than with pixels of three.
    a, b = -gx * camera.fx, -gy * camera.fy
    c = -smooth - a * x - b * y
    length = np.maximum(np.sqrt(a * a + b * b + c * c), 1e-12)
    towards = 1 / np.sqrt(x * x + y * y + 1)
    facing = -(a * x + b * y + c) / length * towards
    # A slope steeper than grazing comes from a depth jump: turn it just towards the camera.
    turn = np.maximum(0.1 - facing, 0.0) * towards
    a, b, c = a / length - turn * x, b / length - turn * y, c / length - turn
    length = np.where(known, np.maximum(np.sqrt(a * a + b * b + c * c), 1e-12), np.inf)
    normals = np.empty((height, width, 3), np.float32)
    for axis, (r, s, t) in enumerate(camera.rotation.T.tolist()):
        normals[..., axis] = (r * a + s * b + t * c) / length
    return normals


def blurred(image: npt.NDArray[np.float64], sigma: float) -> npt.NDArray[np.float64]:
    """Gaussian mean of an image [H, W], out to four sigma; its border is repeated."""
    side = 2 * int(4 * sigma + 0.5) + 1
    return np.asarray(
        cv2.GaussianBlur(image, (side, side), sigma, borderType=cv2.BORDER_REPLICATE), np.float64
    )
