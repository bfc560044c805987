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
from stages.comparison.poses import Motion
from stages.geometry.similarity import similarity

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
        scene: `open3d.t.geometry.RaycastingScene` of the mesh.
        samples: [S, 3] points on it that at least two views see.
        extent: diagonal of its bounding box.
        cameras: the true cameras.
        depths: [H, W] z-depth of the mesh in each, 0 beside it.
    """

    scene: Any
    samples: Array
    extent: float
    cameras: tuple[Camera, ...]
    depths: tuple[npt.NDArray[np.float32], ...]


def read_surface(path: Path, cameras: Sequence[Camera]) -> Surface:
    """Read a mesh in the frame of the true cameras.

    Raises:
        RequestError: it can't be read, has no triangles, or fewer than two of the cameras see it.
    """
    import open3d

    path = path.expanduser()
    mesh = open3d.io.read_triangle_mesh(path) if path.is_file() else None
    if mesh is None or not mesh.has_triangles():
        raise RequestError(f"--mesh: {path} holds no triangle mesh. Give a .ply, .stl or .obj.")
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    seen = [depth_of(scene, camera) for camera in cameras]
    points = [
        camera.unproject(depth)[depth > 0] for camera, depth in zip(cameras, seen, strict=True)
    ]
    stacked = np.concatenate(points) if points else np.zeros((0, 3))
    extent = float(np.linalg.norm(mesh.get_max_bound() - mesh.get_min_bound()))
    count = np.zeros(len(stacked))
    for camera, depth in zip(cameras, seen, strict=True):
        there = _looked_up(depth, camera, stacked)
        away = camera.project(stacked)[1]
        count += (there > 0) & (np.abs(there - away) < 0.005 * extent)
    twice = stacked[count >= 2]
    if len(twice) == 0:
        raise RequestError(
            f"--mesh: no part of {path} is seen by two of the true cameras. Is it in the frame of "
            "--ground-truth?"
        )
    return Surface(scene, drawn(twice), extent, tuple(cameras), tuple(seen))


def depth_of(scene: Any, camera: Camera) -> npt.NDArray[np.float32]:
    """[H, W] z-depth of a mesh as a camera sees it, 0 where it doesn't."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
    )
    origin = np.broadcast_to(camera.centre, local.shape)
    rays = np.concatenate([origin, local @ camera.rotation], -1).astype(np.float32)
    distance = scene.cast_rays(_tensor(rays))["t_hit"].numpy()  # in units of the ray's z
    return np.where(np.isfinite(distance), distance, np.float32(0))


def _tensor(values: Array | npt.NDArray[np.float32]) -> Any:
    import open3d

    return open3d.core.Tensor.from_numpy(np.ascontiguousarray(values, np.float32))


def _looked_up(depth: npt.NDArray[np.float32], camera: Camera, points: Array) -> Array:
    """[N] depth map's value where points [N, 3] project to, 0 outside."""
    pixels, away = camera.project(points)
    column, row = np.floor(np.clip(pixels, -1, 1e6)).astype(np.int64).T
    inside = (away > 0) & (column >= 0) & (row >= 0)
    inside &= (column < camera.width) & (row < camera.height)
    value = np.zeros(len(points))
    value[inside] = depth[row[inside], column[inside]]
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
    distance = _nearest(surface.scene, sample)[1]
    covered = cKDTree(chosen).query(surface.samples)[0]
    near = NEAR * surface.extent
    return {
        "points_on_mesh": len(chosen),
        "accuracy": _figures(distance),
        "completeness": _figures(covered),
        "covered_percent": 100 * float((covered < near).mean()),
        "covered_within": near,
    }


def _towards(points: Array, surface: Surface) -> Motion:
    """A step of the alignment of points [N, 3] to a surface, both ways.

    By the way from the points to the surface alone, a free scale would shrink them into a patch.
    """
    nearest, away = _nearest(surface.scene, points)
    back, index = cKDTree(points).query(surface.samples)
    close, covered = away <= np.quantile(away, KEPT), back <= np.quantile(back, KEPT)
    source = np.concatenate([points[close], points[index[covered]]])
    target = np.concatenate([nearest[close], surface.samples[covered]])
    share = [np.full(int(k.sum()), 1 / k.sum()) for k in (close, covered)]
    return similarity(source, target, np.concatenate(share))


def _nearest(scene: Any, points: Array) -> tuple[Array, Array]:
    tensor = _tensor(points)
    found = scene.compute_closest_points(tensor)["points"].numpy().astype(np.float64)
    return found, np.linalg.norm(found - points, axis=1)


def against_cloud(points: Array, motion: Motion, other: Array, extent: float) -> dict[str, Any]:
    """Distances between two clouds after a similarity, in % of an extent.

    Args:
        points: [N, 3].
        motion: similarity to the frame of `other`.
        other: [M, 3].
        extent: length in that frame.
    """
    if not len(points) or not len(other):
        return {}
    moved = moved_by(drawn(points), motion)
    towards = cKDTree(other).query(moved)[0]
    back = cKDTree(moved_by(points, motion)).query(drawn(other))[0]
    return {
        "to_other_percent": _figures(100 * towards / extent),
        "from_other_percent": _figures(100 * back / extent),
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


def _figures(values: Array) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "mean": float(values.mean()),
        "p90": float(np.quantile(values, 0.9)),
    }
