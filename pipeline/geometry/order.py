"""The order in which one walks past the views."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: How many starting views the search for the shortest path tries; fewer where there are very many.
_STARTS = 12
_STARTS_TIMES_VIEWS = 600


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
