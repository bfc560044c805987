"""Does a light beside the lens explain how colours change from one photograph to the next?

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
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from stages.fit.initial import Cloud, smooth_normals
from stages.fit.targets import point_depth

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

#: shares of light from the lens that are tried, the first of them none
SHARES = np.linspace(0, 0.95, 20)
#: points that are compared at most; photographs share the surface if they share so many of them
MOST_POINTS, LEAST_SHARED = 40000, 200
#: neighbours that a normal is averaged over: shading is compared over some pixels, not over one
NEIGHBOURS = 25
#: the photographs' blur (px) for the same reason
BLUR = 1.5
#: cosines that count: at more of a slant points are seen too poorly; facing the camera they would
#: be in the highlights of a light beside the lens, which the shading does not predict
COSINES, WHITE = (0.2, 0.97), 0.95
#: depth at which a point counts as the surface that a view sees, relative
SAME_SURFACE = 0.01


@dataclass(frozen=True)
class Sight:
    """What a photograph shows of the points.

    Attributes:
        seen: [N] bool.
        radiance: [N] linear light.
        cosine: [N] between normal and line of sight.
    """

    seen: Bools
    radiance: Array
    cosine: Array


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
    smooth = smooth_normals(cloud, NEIGHBOURS)
    points = smooth.select(np.arange(len(cloud)) % max(every, 1) == 0)
    sights = [
        _sight(points, cloud.positions, image, mask, camera, gamma)
        for image, mask, camera in zip(images, masks, cameras, strict=True)
    ]
    pairs = []
    for a, b in itertools.permutations(sights, 2):
        both = a.seen & b.seen
        if both.sum() >= LEAST_SHARED:
            pairs.append((_only(a, both), _only(b, both)))
    if not pairs:
        return None
    errors = [_error(pairs, share, gamma) for share in SHARES]
    return errors[0], min(errors)


def _sight(
    points: Cloud, surface: Array, image: Floats, mask: Bools, camera: Camera, gamma: float
) -> Sight:
    pixels, depth = camera.project(points.positions)
    column = np.clip(np.floor(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
    row = np.clip(np.floor(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
    front = point_depth(surface, camera, camera.width, camera.height)[row, column]
    ray = camera.centre - points.positions
    cosine = (points.normals * ray).sum(1) / np.linalg.norm(ray, axis=1)
    grey = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.float64)[row, column].mean(1)
    seen = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1) & (depth > 0)
    seen &= mask[row, column] & (front > 0) & (np.abs(depth - front) < SAME_SURFACE * depth)
    seen &= (cosine > COSINES[0]) & (cosine < COSINES[1]) & (grey < WHITE)
    return Sight(seen, np.maximum(grey, 1e-3) ** gamma, cosine)


def _only(sight: Sight, rows: Bools) -> Sight:
    return Sight(sight.seen[rows], sight.radiance[rows], sight.cosine[rows])


def _error(pairs: list[tuple[Sight, Sight]], share: float, gamma: float) -> float:
    errors = []
    for a, b in pairs:
        lit_a, lit_b = (1 - share + share * sight.cosine for sight in (a, b))
        predicted = a.radiance * lit_b / lit_a
        # an exposure that changes from one photograph to the next says nothing of where light is
        predicted = predicted * np.median(b.radiance / predicted)
        shown, true = predicted ** (1 / gamma), b.radiance ** (1 / gamma)
        errors.append(np.abs(np.minimum(shown, 1) - true).mean())
    return float(np.mean(errors))
