"""Geometry against a true mesh: accuracy, completeness, F-score, Chamfer distance.

Knapitsch et al., "Tanks and Temples", SIGGRAPH 2017 (precision, recall and F-score at a distance);
Jensen et al., "DTU", CVPR 2014 (accuracy and completeness, restricted to what was observed).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.geometry.mesh import Mesh, distance_figures
from pipeline.geometry.similarity import similarity

Array = npt.NDArray[np.float64]

#: Both surfaces are thinned to a point per cube of this share of the mesh's diagonal, so that no
#: part counts more for having been seen from nearer or more often.
SPACING = 1 / 500
#: ICP goes by the points within so many median distances: the others may belong to what the mesh
#: does not have, and squares would follow them.
_TRIM = 2.5
_ICP_STEPS = 60


def nearest_distances(points: Array, others: Array) -> Array:
    """[N] distance of each point [N, 3] to the nearest of others [M, 3]; infinite if M is 0."""
    from scipy.spatial import cKDTree

    if not len(others):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(others).query(points)[0])


def thinned(points: Array, spacing: float) -> Array:
    """The first point [M, 3] of each cube of a grid that points [N, 3] lie in."""
    cubes = np.floor(points / spacing).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return points[np.sort(first)]


def f_score(accuracy: Array, completeness: Array, distance: float) -> float:
    """Harmonic mean of the shares of points [N] and of true surface [M] within a distance."""
    precision, recall = float((accuracy < distance).mean()), float((completeness < distance).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def surface_figures(
    mesh: Mesh, points: Array, surface: Array, seen: Array, distances: Sequence[float], unit: str
) -> dict[str, Any]:
    """Accuracy, completeness, F-scores and Chamfer distance.

    Args:
        mesh: the truth.
        points: [N, 3] reconstructed points that belong to the mesh: their accuracy is measured.
        surface: [P, 3] all reconstructed points: what is nearest to `seen` is sought among them.
        seen: [M, 3] points of the mesh that should have been reconstructed.
        distances: of the F-scores.
        unit: ``"mm"``, of the mesh's world, or another: figures are then percent of its diagonal.

    Returns:
        accuracy (distance of points to the mesh) and completeness (distance of the mesh to the
        points): median, mean, p90; fscore by distance; chamfer, the mean of the two means; unit.
        `_mm` ends the names where that is the unit.
    """
    factor, suffix = (1.0, "_mm") if unit == "mm" else (100 / mesh.diagonal, "")
    spacing = SPACING * mesh.diagonal
    accuracy = mesh.distances(thinned(points, spacing))
    completeness = nearest_distances(thinned(seen, spacing), surface)
    return {
        f"accuracy{suffix}": distance_figures(accuracy * factor),
        f"completeness{suffix}": distance_figures(completeness * factor),
        "fscore": {
            str(float(distance)): f_score(accuracy * factor, completeness * factor, distance)
            for distance in distances
        },
        "chamfer": 0.5 * factor * float(accuracy.mean() + completeness.mean()),
        "unit": "mm" if unit == "mm" else "percent of the mesh's diagonal",
    }


def icp(mesh: Mesh, points: Array) -> tuple[float, Array, Array]:
    """Similarity that lays points [N, 3] onto a mesh, from near where they belong.

    Iterated closest points (Besl and McKay, PAMI 1992), trimmed (`_TRIM`); scale included, since
    that of a reconstruction is as uncertain as its pose.

    Returns:
        Scale, rotation [3, 3], translation [3]: mesh = s R points + t.
    """
    points = thinned(points, 2 * SPACING * mesh.diagonal)
    scale, rotation, shift = 1.0, np.eye(3), np.zeros(3)
    for _ in range(_ICP_STEPS):
        moved = scale * points @ rotation.T + shift
        target = mesh.closest(moved)
        distance = np.linalg.norm(moved - target, axis=1)
        kept = distance <= _TRIM * np.median(distance)
        scale, rotation, shift = similarity(points, target, kept.astype(np.float64))
        step = np.abs(scale * points @ rotation.T + shift - moved).max()
        if step < 1e-5 * mesh.diagonal:
            break
    return scale, rotation, shift
