"""Sparse points from matches, for cameras that are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.graph import Pair
from pipeline.geometry.world import move_camera
from stages.init.sfm.matching.epipolar import fundamental_between, sampson_distance
from stages.init.sfm.matching.two_view import Correspondences

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tracks:
    """Observations of points that have been linked across views.

    Attributes:
        point: [O] int64, number of the point, rising.
        view: [O] int64.
        pixel: [O, 2] float64.
    """

    point: Integers
    view: Integers
    pixel: Array

    def __getitem__(self, chosen: npt.NDArray[np.bool_]) -> Tracks:
        return Tracks(self.point[chosen], self.view[chosen], self.pixel[chosen])


def agreeing_matches(
    cameras: list[Camera], correspondences: dict[Pair, Correspondences], max_error: float
) -> dict[Pair, Integers]:
    """For each pair [K] the indices of the matches that lie on their epipolar lines.

    Only matches that move along with their neighbours count: on repetitive teeth a wrong match
    often lies on the line by chance.
    """
    agreeing = {}
    for (i, j), found in sorted(correspondences.items()):
        fundamental = fundamental_between(cameras[i], cameras[j])
        distance = sampson_distance(fundamental, found.positions_i, found.positions_j)
        agreeing[i, j] = np.flatnonzero((distance < max_error) & found.coherent)
    return agreeing


def link_tracks(
    positions: list[Array],
    points: list[Integers],
    correspondences: dict[Pair, Correspondences],
    chosen: dict[Pair, Integers],
) -> Tracks:
    """Join matches that share a keypoint into tracks.

    Args:
        positions: for each view [K, 2] pixels of its keypoints.
        points: for each view [K] the keypoint that stands for each keypoint's place.
        correspondences, chosen: matches, and which of them to use.
    """
    start = np.concatenate([[0], np.cumsum([len(those) for those in positions])])
    first, second = [], []
    for (i, j), indices in sorted(chosen.items()):
        features = correspondences[i, j].features[indices]
        first.append(start[i] + points[i][features[:, 0]])
        second.append(start[j] + points[j][features[:, 1]])
    if not first:
        return Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    a, b = np.concatenate(first), np.concatenate(second)
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(start[-1], start[-1]))
    _, label = connected_components(graph, directed=False)
    nodes = np.unique(np.concatenate([a, b]))
    view = np.searchsorted(start, nodes, side="right") - 1
    # A track with two places in one view has a wrong match in it: the first place stays.
    _, once = np.unique(label[nodes] * len(positions) + view, return_index=True)
    nodes, view = nodes[once], view[once]
    _, point = np.unique(label[nodes], return_inverse=True)
    order = np.lexsort((view, point))
    pixel = np.concatenate(positions)[nodes]
    return Tracks(point[order].astype(np.int64), view[order].astype(np.int64), pixel[order])


def triangulate(
    cameras: list[Camera], tracks: Tracks, max_error: float, min_tri_angle: float
) -> tuple[Array, Tracks]:
    """Linear triangulation (DLT), twice: the second time without what did not fit.

    Args:
        max_error: reprojection error in pixels beyond which an observation is dropped.
        min_tri_angle: degrees; points that are seen under less are dropped.

    Returns:
        points [P, 3] in the world, and the observations of each that were kept.
    """
    tracks = _of_several(tracks)
    cameras, scale, middle = _near_origin(cameras)
    for _ in range(2):
        points = _intersections(cameras, tracks)
        fits = _errors(cameras, tracks, points) < max_error
        tracks = _of_several(tracks[fits])
    points = _intersections(cameras, tracks)
    good = _errors(cameras, tracks, points) < max_error
    wide = _widest_angle(cameras, tracks, points) >= min_tri_angle
    kept = np.ones(len(points), bool)
    np.logical_and.at(kept, tracks.point, good)
    kept &= wide
    number = np.cumsum(kept) - 1
    tracks = tracks[kept[tracks.point]]
    return points[kept] / scale + middle, Tracks(number[tracks.point], tracks.view, tracks.pixel)


def _near_origin(cameras: list[Camera]) -> tuple[list[Camera], float, Array]:
    """The cameras around the origin, at a distance of about 1, and (scale, middle [3]) of
    new = scale (old - middle): squares of a map's coordinates leave nothing of a scene."""
    centres = np.array([camera.centre for camera in cameras])
    middle = centres.mean(0)
    spread = float(np.linalg.norm(centres - middle, axis=1).mean())
    scale = 1 / spread if spread > 0 else 1.0
    motion = scale, np.eye(3), -scale * middle
    return [move_camera(camera, motion) for camera in cameras], scale, middle


def _of_several(tracks: Tracks) -> Tracks:
    """The tracks of at least two observations, numbered from 0."""
    count = np.bincount(tracks.point)
    tracks = tracks[count[tracks.point] >= 2] if len(tracks.point) else tracks
    _, number = np.unique(tracks.point, return_inverse=True)
    return Tracks(number.astype(np.int64), tracks.view, tracks.pixel)


def _intersections(cameras: list[Camera], tracks: Tracks) -> Array:
    """[P, 3] points nearest to the rays of their observations, in the algebraic sense."""
    size = int(tracks.point[-1]) + 1 if len(tracks.point) else 0
    normal = np.zeros((size, 4, 4))
    for number, camera in enumerate(cameras):
        mine = tracks.view == number
        pose = camera.cam_from_world[:3]
        ray = (tracks.pixel[mine] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        rows = ray[:, :, None] * pose[2] - pose[:2]  # [K, 2, 4]
        np.add.at(normal, tracks.point[mine], rows.transpose(0, 2, 1) @ rows)
    smallest = np.linalg.eigh(normal)[1][:, :, 0]
    last = np.where(np.abs(smallest[:, 3]) < 1e-12, 1e-12, smallest[:, 3])
    return np.asarray(smallest[:, :3] / last[:, None])


def _errors(cameras: list[Camera], tracks: Tracks, points: Array) -> Array:
    """[O] reprojection errors in pixels, infinite behind the camera."""
    error = np.full(len(tracks.point), np.inf)
    for number, camera in enumerate(cameras):
        mine = np.flatnonzero(tracks.view == number)
        pixel, depth = camera.project(points[tracks.point[mine]])
        distance = np.linalg.norm(pixel - tracks.pixel[mine], axis=1)
        error[mine] = np.where(depth > 0, distance, np.inf)
    return error


def _widest_angle(cameras: list[Camera], tracks: Tracks, points: Array) -> Array:
    """[P] degrees between the first observation of a point and the one furthest from it."""
    centres = np.array([camera.centre for camera in cameras])
    rays = points[tracks.point] - centres[tracks.view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    first = np.searchsorted(tracks.point, np.arange(len(points)))
    cosine = np.clip((rays * rays[first][tracks.point]).sum(1), -1, 1)
    angle = np.zeros(len(points))
    np.maximum.at(angle, tracks.point, np.degrees(np.arccos(cosine)))
    return angle
