"""What the image itself says about a pixel: grey value, highlights; and normals from depth."""

from __future__ import annotations

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
    mass = ndimage.gaussian_filter(trust, sigma_px, mode="nearest")
    smooth = ndimage.gaussian_filter(trust * inverse, sigma_px, mode="nearest")
    smooth = np.where(mass > 1e-9, smooth / np.maximum(mass, 1e-9), inverse)
    gy, gx = np.gradient(smooth)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x = (u - camera.cx) / camera.fx
    y = (v - camera.cy) / camera.fy
    a, b = gx * camera.fx, gy * camera.fy
    normal = -np.stack([a, b, smooth - a * x - b * y], -1)
    # A slope steeper than grazing comes from a depth jump: turn it just towards the camera.
    ray = np.stack([x, y, np.ones_like(x)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    facing = -(normal * ray).sum(-1)
    normal -= np.maximum(0.1 - facing, 0.0)[..., None] * ray
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    world = normal @ camera.rotation
    return np.where(known[..., None], world, 0.0).astype(np.float32)
