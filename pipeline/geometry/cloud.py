"""From depth maps to one coloured cloud and to pointmaps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.artifacts.points import Points
from pipeline.geometry.graph import Pair

Array = npt.NDArray[np.float32]

#: Of what was filled in, one pixel in so many (in x and y) becomes a point.
FILL_STEP = 4
#: So many points tell how far those of a cloud lie from each other.
SPACED = 20_000


def depth_points(
    image: Array, depth: Array, normal: Array, confidence: Array, camera: Camera, step: int = 1
) -> Points:
    """Lift every `step`-th pixel of a depth map that has depth into the world.

    Args:
        image: [H, W, 3] float32 sRGB.
        depth: [H, W] z-depth, 0 where unknown.
        normal: [H, W, 3] unit vectors in the world, 0 where unknown.
        confidence: [H, W], >= 1.
    """
    chosen = np.zeros(depth.shape, bool)
    chosen[step // 2 :: step, step // 2 :: step] = True
    chosen &= depth > 0
    return Points(
        positions=camera.unproject(depth)[chosen].astype(np.float32),
        colors=np.asarray(image[chosen], np.float32),
        normals=np.asarray(normal[chosen], np.float32),
        confidence=np.asarray(confidence[chosen], np.float32),
        scale=(depth[chosen] * (step / camera.fx)).astype(np.float32),
    )


def sparse_points(
    positions: npt.NDArray[np.float64], images: list[Array], cameras: list[Camera]
) -> Points:
    """Points [P, 3] of the reconstruction, coloured by the views that they project into.

    Their confidence is 2: matched and triangulated, but not looked at by dense stereo. The scale
    is the distance to the nearest neighbours, as in 3D Gaussian Splatting.
    """
    colors = np.zeros((len(positions), 3))
    normals = np.zeros((len(positions), 3))
    count = np.zeros(len(positions))
    for image, camera in zip(images, cameras, strict=True):
        pixels, depth = camera.project(positions)
        column, row = np.floor(pixels).astype(np.int64).T
        inside = camera.shows(pixels, depth)
        colors[inside] += image[row[inside], column[inside]]
        count[inside] += 1
        towards = camera.centre - positions
        normals += towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Points(
        positions=positions.astype(np.float32),
        colors=(colors / np.maximum(count, 1)[:, None]).astype(np.float32),
        normals=(normals / length).astype(np.float32),
        confidence=np.full(len(positions), 2, np.float32),
        scale=neighbour_distances(positions),
    )


def neighbour_distances(positions: npt.NDArray[np.float64]) -> Array:
    """[P] float32 mean distance of points [P, 3] to the three nearest others, or what there are."""
    neighbours = min(4, len(positions))
    if neighbours < 2:
        return np.zeros(len(positions), np.float32)
    distances = cKDTree(positions).query(positions, k=neighbours)[0]
    return np.asarray(distances[:, 1:].mean(1), np.float32)


def median_spacing(positions: npt.NDArray[np.floating], threads: int = 1) -> float:
    """Median distance to the nearest neighbour, of an even sample of points [N, 3]; 0 of one."""
    if len(positions) < 2:
        return 0.0
    points = np.asarray(positions, np.float64)
    some = points[:: max(1, len(points) // SPACED)]
    # for few queries: what makes many fast takes longer than they do
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    return float(np.median(tree.query(some, 2, workers=max(threads, 1))[0][:, 1]))


def joined(clouds: list[Points]) -> Points:
    """All points of several clouds, in their order."""
    return Points(
        positions=np.concatenate([cloud.positions for cloud in clouds]),
        colors=np.concatenate([cloud.colors for cloud in clouds]),
        normals=np.concatenate([cloud.normals for cloud in clouds]),
        confidence=np.concatenate([cloud.confidence for cloud in clouds]),
        scale=np.concatenate([cloud.scale for cloud in clouds]),
    )


def thinned(points: Points, count: int, seed: int) -> Points:
    """At most `count` of the points, drawn evenly, in their old order, with their scale grown.

    Dropping all but one in k points of a surface makes their spacing sqrt(k) times larger.
    """
    if len(points) <= count:
        return points
    drawn = np.sort(np.random.default_rng(seed).permutation(len(points))[:count])
    fewer = points[drawn]
    growth = np.float32(np.sqrt(len(points) / count))
    return Points(
        fewer.positions, fewer.colors, fewer.normals, fewer.confidence, fewer.scale * growth
    )


def pointmap_pair(
    camera_i: Camera, camera_j: Camera, depth_i: Array, depth_j: Array,
    confidence_i: Array, confidence_j: Array,
) -> PointmapPair:  # fmt: skip
    """Two depth maps [H, W] as pointmaps in the frame of the first camera.

    Confidence is exactly 1 where there is no depth; the points there are the camera's centre.
    """
    return PointmapPair(
        name_i=camera_i.name,
        name_j=camera_j.name,
        points_i=_in_frame(camera_i, camera_i, depth_i),
        points_j_in_i=_in_frame(camera_j, camera_i, depth_j),
        confidence_i=np.where(depth_i > 0, confidence_i, 1).astype(np.float32),
        confidence_j=np.where(depth_j > 0, confidence_j, 1).astype(np.float32),
    )


def _in_frame(camera: Camera, frame: Camera, depth: Array) -> Array:
    world = camera.unproject(depth)
    return np.asarray(world @ frame.rotation.T + frame.translation, np.float32)


def pointmap_edges(weights: dict[Pair, float], tree: list[Pair], view_count: int) -> list[Pair]:
    """The pairs to write: the spanning tree and the next best, as many as there are views."""
    edges = set(tree)
    for pair in sorted(weights, key=lambda pair: (-weights[pair], pair)):
        if len(edges) >= view_count:
            break
        edges.add(pair)
    return sorted(edges)
