"""The order in which one walks past the views, and which of them look at the same from nearby."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float64]

#: How many starting views the search for the shortest path tries; fewer where there are very many.
_STARTS = 12
_STARTS_TIMES_VIEWS = 600

#: Points of a view that are asked where they are seen: enough for shares of a twentieth.
_ASKED = 400
#: Views that are asked about what one sees: those nearest. All of up to twelve; with more, asking
#: all would take time that grows with the square of their number.
_MOST_VIEWS = 11
#: A view that sees less of these than this share shows another part of the scene.
_LEAST_SHARE = 0.05


def viewing_order(centres: npt.NDArray[np.floating]) -> list[int]:
    """Order views along the shortest path through their camera centres.

    On an arc around the teeth this is the order in which one walks past them, whatever order the
    photographs came in. The path is found from nearest-neighbour tours improved by reversing and
    moving stretches (2-opt, or-opt): exact in practice for a few dozen views along a curve.

    Args:
        centres: [N, 3] camera centres, any units.

    Returns:
        The indices 0..N-1 in viewing order; of the two directions, the one that begins with the
        smaller index.
    """
    centres = np.asarray(centres, np.float64)
    count = len(centres)
    if count < 3:
        return list(range(count))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)  # [N, N]
    tries = min(count, _STARTS, max(1, _STARTS_TIMES_VIEWS // count))
    starts = sorted(set(np.linspace(0, count - 1, tries).astype(int).tolist()))
    candidates = [list(range(count))] + [_nearest_neighbour_path(distance, k) for k in starts]
    best = min(
        (_improve(path, distance) for path in candidates), key=lambda p: _length(p, distance)
    )
    return best if best[0] < best[-1] else best[::-1]


def _nearest_neighbour_path(distance: Array, start: int) -> list[int]:
    path, left = [start], set(range(len(distance))) - {start}
    while left:
        path.append(min(left, key=lambda k: (distance[path[-1], k], k)))
        left.remove(path[-1])
    return path


def _length(path: list[int], distance: Array) -> float:
    return float(distance[path[:-1], path[1:]].sum())


def _improve(path: list[int], distance: Array) -> list[int]:
    """Reverse or move stretches of the open path as long as that shortens it."""
    length, count = _length(path, distance), len(path)
    improved = True
    while improved:
        improved = False
        for first in range(count):
            for last in range(first + 1, count + 1):
                stretch, rest = path[first:last], path[:first] + path[last:]
                moves = [path[:first] + stretch[::-1] + path[last:]]
                if len(stretch) <= 2:  # longer moves are compositions of reversals
                    for at in range(len(rest) + 1):
                        moves.append(rest[:at] + stretch + rest[at:])
                for move in moves:
                    shorter = _length(move, distance)
                    if shorter < length - 1e-12 * (1 + length):
                        path, length, improved = move, shorter, True
    return path


def nearest_views(
    index: int, cameras: list[Camera], points: npt.NDArray[np.floating]
) -> npt.NDArray[np.int64]:
    """The views that see what one sees, under the smallest angles against it.

    Args:
        index: the view in question.
        cameras: V cameras.
        points: [M, 3] world points that it sees.

    Returns:
        Rising indices of other views; all of them where there are no more than `_MOST_VIEWS`.
    """
    others = [view for view in range(len(cameras)) if view != index]
    if len(others) <= _MOST_VIEWS or len(points) == 0:
        return np.array(others[:_MOST_VIEWS] if len(points) == 0 else others, np.int64)
    some = np.asarray(points[:: -(-len(points) // _ASKED)], np.float64)
    rays = some - cameras[index].centre
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    ranked = []
    for view in others:
        camera = cameras[view]
        pixels, depth = camera.project(some)
        seen = camera.shows(pixels, depth)
        towards = some - camera.centre
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        ranked.append((seen.mean() < _LEAST_SHARE, -np.median((rays * towards).sum(1)), view))
    return np.array(sorted(view for _, _, view in sorted(ranked)[:_MOST_VIEWS]), np.int64)


def neighbour_angle(cameras: Sequence[Camera]) -> float:
    """Median over the cameras of the angle to the nearest other one, in degrees.

    Seen from the point that is nearest to all optical axes; 0 where all look the same way.
    """
    if len(cameras) < 2:
        return 0.0
    ahead = np.stack([camera.rotation[2] for camera in cameras])
    centres = np.stack([camera.centre for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    system = across.sum(0)
    if np.linalg.cond(system) > 1e6:
        return 0.0
    target = np.linalg.solve(system, np.einsum("vij,vj->i", across, centres))
    lines = centres - target
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-12)
    cosine = np.clip(lines @ lines.T, -1, 1)
    np.fill_diagonal(cosine, -1)
    return float(np.median(np.degrees(np.arccos(cosine.max(axis=1)))))
