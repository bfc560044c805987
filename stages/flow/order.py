"""Which views are neighbours: how far apart they are, and the pairs that flow is estimated for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

#: How many points the angle between two views is measured on.
_ANGLE_SAMPLES = 2000

#: Below this share of common points two views show different things.
_LEAST_OVERLAP = 0.02


def parallax_angle(
    camera_i: Camera, camera_j: Camera, points: npt.NDArray[np.floating] | None = None
) -> float:
    """How far apart two views are: the angle between their lines of sight, in degrees.

    Args:
        camera_i, camera_j: the cameras.
        points: [N, 3] world points of the scene. With them, the median over those inside both
            images of the angle that the two centres subtend there; without, the angle between the
            optical axes.

    Returns:
        The angle; infinite if hardly any of the points lies inside both images.
    """
    if points is None or len(points) == 0:
        cosine = float(camera_i.rotation[2] @ camera_j.rotation[2])
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    sample = np.asarray(points[:: -(-len(points) // _ANGLE_SAMPLES)], np.float64)
    inside_i, inside_j = (_inside(camera, sample) for camera in (camera_i, camera_j))
    both = inside_i & inside_j
    if both.sum() < max(1.0, _LEAST_OVERLAP * min(inside_i.sum(), inside_j.sum())):
        return float("inf")
    rays = [camera.centre - sample[both] for camera in (camera_i, camera_j)]
    unit_i, unit_j = (ray / np.linalg.norm(ray, axis=-1, keepdims=True) for ray in rays)
    cosines = np.clip((unit_i * unit_j).sum(-1), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosines))))


def _inside(camera: Camera, points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    pixels, depth = camera.project(points)
    within = (pixels >= 0) & (pixels <= (camera.width, camera.height))
    return np.asarray(within.all(-1) & (depth > 0))


def neighbour_pairs(order: list[int], window: int) -> list[tuple[int, int]]:
    """All pairs of views at most `window` places apart in `order`, the earlier one first."""
    return [
        (order[k], order[k + step])
        for k in range(len(order))
        for step in range(1, window + 1)
        if k + step < len(order)
    ]
