"""Point clouds of each stage and of COLMAP against a mesh, or against each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.errors import RequestError
from pipeline.geometry.mesh import Mesh, distance_figures
from pipeline.geometry.similarity import similarity
from pipeline.studies.compare.poses import Motion

Array = npt.NDArray[np.float64]

#: Points that distances are taken of, at most, drawn evenly.
SAMPLES = 50_000
#: Rounds of the alignment of a cloud to a mesh, and the share of the points that it goes by: the
#: rest may be of what the mesh doesn't have.
ROUNDS, KEPT = 20, 0.85
#: Distances, as shares of the mesh's extent, that coverage is given for.
NEAR = 0.01


@dataclass(frozen=True)
class Surface:
    """A true surface, and the views that show it.

    Attributes:
        mesh: the surface.
        samples: [S, 3] points on it that at least two views see.
        cameras: the true cameras.
        depths: [H, W] z-depth of the mesh in each, 0 beside it.
    """

    mesh: Mesh
    samples: Array
    cameras: tuple[Camera, ...]
    depths: tuple[Array, ...]


def read_surface(path: Path, cameras: Sequence[Camera]) -> Surface:
    """Read a mesh in the frame of the true cameras.

    Raises:
        RequestError: it can't be read, has no triangles, or fewer than two of the cameras see it.
    """
    mesh = Mesh.read(path, "--mesh")
    seen = [mesh.depth(camera) for camera in cameras]
    points = [
        camera.unproject(depth)[depth > 0] for camera, depth in zip(cameras, seen, strict=True)
    ]
    stacked = np.concatenate(points) if points else np.zeros((0, 3))
    count = np.zeros(len(stacked))
    for camera, depth in zip(cameras, seen, strict=True):
        there = _looked_up(depth, camera, stacked)
        away = camera.project(stacked)[1]
        count += (there > 0) & (np.abs(there - away) < 0.005 * mesh.diagonal)
    twice = stacked[count >= 2]
    if len(twice) == 0:
        raise RequestError(
            f"--mesh: no part of {path} is seen by two of the true cameras. Is it in the frame of "
            "--ground-truth?"
        )
    return Surface(mesh, drawn(twice), tuple(cameras), tuple(seen))


def _looked_up(depth: Array, camera: Camera, points: Array) -> Array:
    """[N] depth map's value where points [N, 3] project to, 0 outside."""
    pixels, away = camera.project(points)
    inside = camera.shows(pixels, away)
    column, row = pixels[inside].astype(np.int64).T
    value = np.zeros(len(points))
    value[inside] = depth[row, column]
    return value


def drawn(points: Array, count: int = SAMPLES) -> Array:
    """At most `count` of points [N, 3], evenly, always the same ones."""
    if len(points) <= count:
        return points
    chosen = np.random.default_rng(0).permutation(len(points))[:count]
    return np.asarray(points[np.sort(chosen)])


def against_surface(points: Array, motion: Motion, surface: Surface) -> dict[str, Any]:
    """Accuracy and completeness of a cloud on a mesh.

    Only points that project onto the mesh in at least half of the true views that contain them
    count, since the scene has more than the mesh. The cloud is brought onto the mesh by `motion`
    and then a trimmed ICP with scale.

    Args:
        points: [N, 3] in the world of a row's cameras.
        motion: similarity from there to the true frame.
    """
    moved = moved_by(points, motion)
    within, on_mesh = np.zeros(len(moved)), np.zeros(len(moved))
    for camera, depth in zip(surface.cameras, surface.depths, strict=True):
        pixels, away = camera.project(moved)
        inside = (away > 0) & (pixels > 0).all(1) & (pixels[:, 0] < camera.width)
        within += inside & (pixels[:, 1] < camera.height)
        on_mesh += _looked_up(depth, camera, moved) > 0
    chosen = moved[(within > 0) & (2 * on_mesh >= within)]
    if len(chosen) < 10:
        return {"points_on_mesh": len(chosen)}
    sample = drawn(chosen)
    for _ in range(ROUNDS):
        step = _towards(sample, surface)
        sample, chosen = moved_by(sample, step), moved_by(chosen, step)
    distance = surface.mesh.distances(sample)
    covered = cKDTree(chosen).query(surface.samples)[0]
    near = NEAR * surface.mesh.diagonal
    return {
        "points_on_mesh": len(chosen),
        "accuracy": distance_figures(distance),
        "completeness": distance_figures(covered),
        "covered_percent": 100 * float((covered < near).mean()),
        "covered_within": near,
    }


def _towards(points: Array, surface: Surface) -> Motion:
    """A step of the alignment of points [N, 3] to a surface, both ways.

    By the way from the points to the surface alone, a free scale would shrink them into a patch.
    """
    nearest = surface.mesh.closest(points)
    away = np.linalg.norm(nearest - points, axis=1)
    back, index = cKDTree(points).query(surface.samples)
    close, covered = away <= np.quantile(away, KEPT), back <= np.quantile(back, KEPT)
    source = np.concatenate([points[close], points[index[covered]]])
    target = np.concatenate([nearest[close], surface.samples[covered]])
    share = [np.full(int(k.sum()), 1 / k.sum()) for k in (close, covered)]
    return similarity(source, target, np.concatenate(share))


def against_cloud(points: Array, motion: Motion, other: Array, extent: float) -> dict[str, Any]:
    """Distances between two clouds after a similarity, in % of an extent.

    Args:
        points: [N, 3].
        motion: similarity to the frame of `other`.
        other: [M, 3].
        extent: length in that frame; 0: `other` has none, and nothing is measured by it.
    """
    if not len(points) or not extent:
        return {}
    moved = moved_by(drawn(points), motion)
    towards = cKDTree(other).query(moved)[0]
    back = cKDTree(moved_by(points, motion)).query(drawn(other))[0]
    return {
        "to_other_percent": distance_figures(100 * towards / extent),
        "from_other_percent": distance_figures(100 * back / extent),
    }


def moved_by(points: Array, motion: Motion) -> Array:
    """Points [N, 3] after a similarity (scale, rotation, translation)."""
    scale, rotation, shift = motion
    return np.asarray(scale * np.asarray(points, np.float64) @ rotation.T + shift)


def robust_extent(points: Array) -> float:
    """Diagonal of the box that holds the middle 96 % of points [N, 3] along each axis."""
    if not len(points):
        return 0.0
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    return float(np.linalg.norm(high - low))
