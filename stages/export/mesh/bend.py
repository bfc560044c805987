"""The points that a fit started from, on the surface that it ended with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points

#: A point is on the surface that a camera sees there if both differ by less of their depth.
FARTHEST = 0.02
#: A camera has a say where it looks at the surface by at least this cosine.
LEAST_FACING = 0.25


def bent(
    points: Points, cameras: Sequence[Camera], depths: Sequence[npt.NDArray[np.floating]]
) -> Points:
    """Points moved along their normals to where the fitted scene has its surface.

    A fit bends the surface of the points as a whole (`fit.warp_levels`): a mesh that is made of the
    points as they were, or cut where they were, would not be that of the scene. Each camera that
    sees a point says how far the surface is from it; the median counts. What no camera sees goes
    with the nearest that is seen. Points without a normal stay.

    Args:
        points: N of them, in the world of the cameras.
        cameras: K of them.
        depths: K depth maps [H, W] of the fitted scene (z); 0: not trusted.
    """
    known = np.abs(points.normals).sum(1) > 0
    places, normals = points.positions[known].astype(np.float64), points.normals[known]
    said = np.full((len(cameras), len(places)), np.nan)
    for row, camera, depth in zip(said, cameras, depths, strict=True):
        pixels, z = camera.project(places)
        index = np.flatnonzero(camera.shows(pixels, z))
        column, line = pixels[index].astype(np.int64).T
        surface, z = depth[line, column], z[index]
        ray = places[index] - camera.centre
        outward = (ray * normals[index]).sum(1)  # negative: the normal looks at the camera
        near = (surface > 0) & (np.abs(surface - z) < FARTHEST * z)
        near &= -outward > LEAST_FACING * np.linalg.norm(ray, axis=1)
        row[index[near]] = outward[near] * (surface[near] / z[near] - 1)
    seen = np.isfinite(said).any(0)
    if not seen.any():
        return points
    move = np.zeros(len(places))
    move[seen] = np.nanmedian(said[:, seen], axis=0)
    if not seen.all():
        move[~seen] = move[seen][cKDTree(places[seen]).query(places[~seen])[1]]
    positions = points.positions.copy()
    positions[known] += (move[:, None] * normals).astype(np.float32)
    return replace(points, positions=positions)
