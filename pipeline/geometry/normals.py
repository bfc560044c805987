"""Normals of a depth map."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float32]


def depth_normals(depth: Array, confidence: Array, camera: Camera, sigma_px: float = 2.0) -> Array:
    """Unit normals [H, W, 3] float32 in the world, facing the camera, from a depth map [H, W].

    On a plane the inverse depth is linear in the pixel coordinates, and its gradient is the
    normal; it is taken from inverse depths smoothed by a Gaussian, weighted by confidence - 1.
    """
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float64)
    weight = np.where(known, np.maximum(confidence - 1, 1e-4), 0).astype(np.float64)
    mass = ndimage.gaussian_filter(weight, sigma_px, mode="nearest")
    smooth = ndimage.gaussian_filter(weight * inverse, sigma_px, mode="nearest")
    smooth = np.where(mass > 1e-12, smooth / np.maximum(mass, 1e-12), inverse)
    gy, gx = np.gradient(smooth)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    a, b = gx * camera.fx, gy * camera.fy
    normal = -np.stack([a, b, smooth - a * x - b * y], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    ray = np.stack([x, y, np.ones_like(x)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # Steeper than grazing is a depth jump, not a surface: turn it just towards the camera.
    normal -= np.maximum(0.1 + (normal * ray).sum(-1), 0)[..., None] * ray
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return (normal @ camera.rotation).astype(np.float32)
