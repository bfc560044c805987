"""Which views to compare with, and between which depths to look."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float64]

#: Triangulation angles wanted and allowed, degrees.
_BEST_ANGLE, _MIN_ANGLE, _MAX_ANGLE = 12.0, 3.0, 45.0
#: Share of the span of inverse depths added at either end.
_MARGIN = 0.25
#: How far one step from plane to plane moves the match, in pixels.
_STEP = 0.75


def visible_points(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Points [N, 3] that fall inside the image of a camera, and their depths [M]."""
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    pixels, depth = camera.project(points)
    inside = camera.shows(pixels, depth)
    return points[inside], depth[inside]


def scene_points(cameras: list[Camera], sparse: list[npt.NDArray[np.floating]]) -> list[Array]:
    """What each view knows of the scene: its own sparse points, or where it has few, all of them.

    Args:
        cameras: V cameras.
        sparse: V arrays [M_i, 3] of world points that each view sees.

    Returns:
        V arrays [M, 3] float64; a view that sees nothing gets the point nearest to all optical
        axes, so that there is always one.
    """
    own = [np.asarray(points, np.float64).reshape(-1, 3) for points in sparse]
    everything = np.unique(np.concatenate([*own, np.zeros((0, 3))]), axis=0)
    result = []
    for camera, points in zip(cameras, own, strict=True):
        if len(points) < 12:
            points = visible_points(camera, everything)[0]
        result.append(points if len(points) else _axes_meet(cameras)[None])
    return result


def _axes_meet(cameras: list[Camera]) -> Array:
    """The point [3] with the least squared distance to all optical axes."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for camera in cameras:
        axis = camera.rotation[2]
        across = np.eye(3) - np.outer(axis, axis)
        normal += across
        right += across @ camera.centre
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)


def select_sources(index: int, cameras: list[Camera], points: Array, count: int) -> list[int]:
    """Choose the views to compare one view with.

    Each candidate scores its overlap (share of the view's points that it sees) times how near the
    median triangulation angle is to the best one. The second and later choices lose half their
    score for lying on the side of a view that is already chosen, so that what one side hides the
    other can show. If no view lies between the angles allowed, the one nearest to them is taken,
    unless it has no baseline at all.

    Args:
        index: the reference.
        cameras: V cameras.
        points: [M, 3] world points that the reference sees.
        count: at most this many.

    Returns:
        Indices, best first.
    """
    reference = cameras[index]
    rays = points - reference.centre
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    middle = np.median(points, axis=0)
    candidates, spares = [], []
    for other, camera in enumerate(cameras):
        if other == index:
            continue
        towards = points - camera.centre
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        angle = float(np.median(np.degrees(np.arccos(np.clip((rays * towards).sum(1), -1, 1)))))
        overlap = len(visible_points(camera, points)[0]) / len(points)
        width = 6.0 if angle < _BEST_ANGLE else 15.0
        score = overlap * float(np.exp(-0.5 * ((angle - _BEST_ANGLE) / width) ** 2))
        side = camera.centre - reference.centre
        side = side - (side @ (middle - reference.centre)) * (middle - reference.centre) / max(
            float((middle - reference.centre) @ (middle - reference.centre)), 1e-12
        )
        side /= max(float(np.linalg.norm(side)), 1e-12)
        if _MIN_ANGLE <= angle <= _MAX_ANGLE and overlap > 0.05:
            candidates.append((score, other, side))
        elif angle > 0.3 and overlap > 0.05:
            miss = _MIN_ANGLE - angle if angle < _MIN_ANGLE else angle - _MAX_ANGLE
            spares.append((-miss, other, side))
    if not candidates:
        spares.sort(key=lambda entry: (-entry[0], entry[1]))
        return [other for _, other, _ in spares[:1]]
    chosen: list[int] = []
    sides: list[Array] = []
    while candidates and len(chosen) < count:
        worth = [
            score * (0.5 ** sum(float(side @ taken) > 0.5 for taken in sides))
            for score, _, side in candidates
        ]
        best = max(range(len(candidates)), key=lambda k: (worth[k], -candidates[k][1]))
        _, other, side = candidates.pop(best)
        chosen.append(other)
        sides.append(side)
    return chosen


def inverse_depth_range(camera: Camera, own: Array, everything: Array) -> tuple[float, float]:
    """Between which inverse depths to look for the surface.

    Args:
        camera: the view.
        own: [M, 3] world points that it sees.
        everything: [N, 3] all known points; those inside the image count too.

    Returns:
        Inverse z-depth of the farthest and of the nearest plane.
    """
    depth = np.concatenate([visible_points(camera, own)[1], visible_points(camera, everything)[1]])
    if len(depth) == 0:
        depth = np.maximum(camera.project(own)[1], 1e-6)
    inverse = 1.0 / depth
    far, near = np.percentile(inverse, [1.5, 98.5])
    # A handful of points says little about the ends.
    share = _MARGIN * (2.0 if len(depth) < 50 else 1.0)
    span = max(near - far, 0.1 * near)
    return max(far - share * span, 0.2 * far), near + share * span


def plane_count(
    camera: Camera,
    sources: list[Camera],
    inverse_range: tuple[float, float],
    least: int,
    most: int,
) -> int:
    """Planes so that one step moves the match by about `_STEP` pixels in the farthest source."""
    corners = np.array(
        [[u * camera.width, v * camera.height, 1.0] for u in (0.25, 0.5, 0.75) for v in (0.3, 0.7)]
    )
    rays = corners @ np.linalg.inv(camera.matrix).T
    longest = 0.0
    for source in sources:
        ends = []
        for inverse in inverse_range:
            world = (rays / inverse - camera.translation) @ camera.rotation
            pixels, depth = source.project(world)
            ends.append(np.where((depth > 0)[:, None], pixels, np.nan))
        moved = np.linalg.norm(ends[1] - ends[0], axis=1)
        if np.isfinite(moved).any():
            longest = max(longest, float(np.nanmedian(moved)))
    return int(np.clip(np.ceil(longest / _STEP) + 1, least, most))
