"""A light beside the lens: does it explain the photographs, and what it falls on to begin with.

Photographs too far apart to predict one another as a whole still share surface. Under room light a
point looks alike in both; under a flash that moves with the camera it is brighter where it faces
the camera and where it is near. So the colour of each point in one photograph is predicted from
another one, once as it is and once with the shading of a light beside the lens undone and redone.
Only the shading counts: highlights are left to the fit, and that it gets darker with distance may
be the cheek's shadow.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.inputs.initial import Cloud, facing, smooth_normals
from stages.fit.inputs.targets import point_depth

if TYPE_CHECKING:
    from stages.fit.config import FitSettings

#: shares of light from the lens that are tried, the first of them none
SHARES = np.linspace(0, 0.95, 20)
#: points that are compared at most; photographs share the surface if they share so many of them
MOST_POINTS, LEAST_SHARED = 10000, 200
#: neighbours that a normal is averaged over: shading is compared over some pixels, not over one
NEIGHBOURS = 25
#: the photographs' blur (px) for the same reason
BLUR = 1.5
#: cosines that count: at more of a slant points are seen too poorly; facing the camera they would
#: be in the highlights of a light beside the lens, which the shading does not predict
COSINES, WHITE = (0.2, 0.97), 0.95


def sighted(
    positions: Array, surface: Array, mask: Bools, camera: Camera, tolerance: float
) -> tuple[Indices, Indices, Bools]:
    """[N] row and column of points [N, 3] in an image, and whether it shows them.

    It does where its mask lets it, and where they are as far away as the surface [M, 3] that it
    sees there, to within a share `tolerance` of the depth.
    """
    pixels, depth = camera.project(positions)
    column = np.clip(np.floor(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
    row = np.clip(np.floor(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
    front = point_depth(surface, camera, camera.width, camera.height)[row, column]
    seen = camera.shows(pixels, depth)
    seen &= mask[row, column] & (front > 0) & (np.abs(depth - front) < tolerance * depth)
    return row, column, seen


def prediction_errors(
    cloud: Cloud,
    images: Sequence[Floats],
    masks: Sequence[Bools],
    cameras: Sequence[Camera],
    gamma: float,
) -> tuple[float, float] | None:
    """Errors of predicting photographs from one another, without and with a light at the lens.

    Args:
        cloud: points of the surface, those that were measured.
        images: [H, W, 3] float32 sRGB in 0..1 of the views; masks: [H, W] where they may be used.
        cameras: theirs, in the frame of the points.
        gamma: exponent of the photographs' encoding.

    Returns:
        Mean absolute errors (sRGB, 0..1) without a light and with the best one, each pair of
        photographs with one gain; None where no two photographs share enough surface.
    """
    every = -(-len(cloud) // MOST_POINTS)
    points = smooth_normals(cloud, NEIGHBOURS, max(every, 1))
    sights = [
        _sight(points, cloud.positions, image, mask, camera, gamma)
        for image, mask, camera in zip(images, masks, cameras, strict=True)
    ]
    pairs = []
    for a, b in itertools.permutations(sights, 2):
        both = a[0] & b[0]
        if both.sum() >= LEAST_SHARED:
            pairs.append([part[both] for part in (*a[1:], *b[1:])])
    if not pairs:
        return None
    errors = [_error(pairs, share, gamma) for share in SHARES]
    return errors[0], min(errors)


def _sight(
    points: Cloud, surface: Array, image: Floats, mask: Bools, camera: Camera, gamma: float
) -> tuple[Bools, Array, Array]:
    """[N] which points a photograph shows, their linear light, and cosine of the line of sight."""
    row, column, seen = sighted(points.positions, surface, mask, camera, 0.01)
    ray = camera.centre - points.positions
    cosine = (points.normals * ray).sum(1) / np.linalg.norm(ray, axis=1)
    grey = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.float64)[row, column].mean(1)
    seen &= (cosine > COSINES[0]) & (cosine < COSINES[1]) & (grey < WHITE)
    return seen, np.maximum(grey, 1e-3) ** gamma, cosine


def _error(pairs: list[list[Array]], share: float, gamma: float) -> float:
    errors = []
    for radiance_a, cosine_a, radiance_b, cosine_b in pairs:
        predicted = radiance_a * (1 - share + share * cosine_b) / (1 - share + share * cosine_a)
        # an exposure that changes from one photograph to the next says nothing of where light is
        predicted = predicted * np.median(radiance_b / predicted)
        shown, true = predicted ** (1 / gamma), radiance_b ** (1 / gamma)
        errors.append(np.abs(np.minimum(shown, 1) - true).mean())
    return float(np.mean(errors))


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
        row, column, seen = sighted(cloud.positions, surface, mask, camera, 0.02)
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
