"""What Gaussians are made of to begin with, where a light beside the lens is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from stages.fit.config import FitSettings
from stages.fit.initial import Cloud, facing
from stages.fit.targets import point_depth

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

#: depth at which a point counts as the surface that a view sees, relative
SAME_SURFACE = 0.02


def initial_material(
    cloud: Cloud,
    surface: Array,
    images: Sequence[Floats],
    masks: Sequence[Bools],
    cameras: Sequence[Camera],
    settings: FitSettings,
) -> Floats:
    """Albedo and normal to start from: what the views show, less the light.

    Each view that sees a point tells its colour; where the model expects a highlight, or the pixel
    is nearly white, it hardly counts.

    Args:
        cloud: the points that become Gaussians.
        surface: [M, 3] all points: what hides what.
        images: [H, W, 3] of the views; masks: [H, W] where they may be used.
        cameras: theirs, in the frame of the fit.
        settings: the light to start from.

    Returns:
        [N, 6] float32.
    """
    s = settings
    count = len(cloud)
    middle = np.mean([camera.centre for camera in cameras], 0)
    towards = middle - cloud.positions
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    known = np.abs(cloud.normals).sum(1) > 0
    normals = np.where(known[:, None], cloud.normals, towards)
    total, mass = np.zeros((count, 3)), np.zeros(count)
    for image, mask, camera in zip(images, masks, cameras, strict=True):
        pixels, depth = camera.project(cloud.positions)
        column = np.clip(np.floor(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
        row = np.clip(np.floor(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        front = point_depth(surface, camera, camera.width, camera.height)[row, column]
        seen = inside & (depth > 0) & mask[row, column]
        seen &= (front > 0) & (np.abs(depth - front) < SAME_SURFACE * depth)
        colour = np.asarray(image[row, column], np.float64)
        ray = camera.centre - cloud.positions
        distance = np.linalg.norm(ray, axis=1)
        cosine = (normals * ray).sum(1) / distance
        lit = matte(cosine, distance, s)
        # half as narrow as the lobe that is expected: normals are not exact
        highlight = np.exp(0.5 * s.light_widths[0] * (cosine - 1))
        weight = seen * np.clip(cosine, 0, 1) * np.exp(-4 * highlight)
        weight = weight * np.clip((1.02 - colour.max(1)) / 0.2, 0.02, 1)
        total += weight[:, None] * colour**s.light_gamma / lit[:, None]
        mass += weight
    typical = facing(cloud.positions, normals, cameras)
    away = np.linalg.norm(middle - cloud.positions, axis=1)
    plain = cloud.colors**s.light_gamma / matte(typical, away, s)[:, None]
    # a thousandth of a good sight: the cloud's own colour where no view tells better
    radiance = (total + 1e-3 * plain) / (mass + 1e-3)[:, None]
    albedo = np.clip(radiance, 1e-6, 4) ** (1 / s.light_gamma)
    return np.ascontiguousarray(np.concatenate([albedo, normals], 1), np.float32)


def matte(cosine: Array, distance: Array, s: FitSettings) -> Array:
    """[N] light on a surface without highlights, held off 0."""
    diffuse = 1 - s.light_diffuse + s.light_diffuse * np.clip(cosine, 0, 1)
    return np.maximum(diffuse / distance**s.light_falloff, 0.15)
