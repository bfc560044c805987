"""Normals of a depth map."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float32]

#: Weight of a depth of the least confidence, 1; of others it is what they have more.
UNSURE = np.float32(1e-4)


def depth_normals(depth: Array, weight: Array, camera: Camera, sigma_px: float = 2.0) -> Array:
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
    mass, smooth = _blurred(trust, sigma_px), _blurred(trust * inverse, sigma_px)
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


def _blurred(image: npt.NDArray[np.float64], sigma: float) -> npt.NDArray[np.float64]:
    """Gaussian mean of an image [H, W], out to four sigma; its border is repeated."""
    side = 2 * int(4 * sigma + 0.5) + 1
    return np.asarray(
        cv2.GaussianBlur(image, (side, side), sigma, borderType=cv2.BORDER_REPLICATE), np.float64
    )
