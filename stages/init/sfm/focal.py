"""Finding the focal length when the photographs don't tell it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stages.init.sfm.mapping import Solution

#: Focal lengths over the long side of the image, from wide angle to macro.
CANDIDATES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1)


@dataclass(frozen=True)
class FocalResult:
    """The focal length chosen.

    Attributes:
        ratio: focal length over the long side.
        solution: the reconstruction with it.
        determined: False if the reprojection error has no minimum inside the range searched, so
            that the focal length is a guess.
    """

    ratio: float
    solution: Solution
    determined: bool


def better(first: Solution | None, second: Solution | None) -> Solution | None:
    """The solution with more views, or as many and the smaller reprojection error."""
    if first is None or second is None:
        return second if first is None else first
    rank_first = (-len(first.poses), first.error)
    rank_second = (-len(second.poses), second.error)
    return second if rank_second < rank_first else first


def search_focal(
    solve: Callable[[float], Solution | None], candidates: Sequence[float] = CANDIDATES
) -> FocalResult | None:
    """Reconstruct with each candidate, then at the minimum of the error between them.

    Args:
        solve: gives the reconstruction for a focal length over the long side.
        candidates: increasing.

    Returns:
        None if no candidate places any views.
    """
    found = [(ratio, solve(ratio)) for ratio in candidates]
    best_index, best = -1, None
    for index, (_, solution) in enumerate(found):
        if solution is not None and better(best, solution) is solution:
            best_index, best = index, solution
    if best is None:
        return None
    around = found[max(best_index - 1, 0) : best_index + 2]
    if len(around) < 3 or any(
        solution is None or len(solution.poses) < len(best.poses) for _, solution in around
    ):
        return FocalResult(found[best_index][0], best, determined=False)
    ratio = _parabola_minimum(
        [np.log(ratio) for ratio, _ in around],
        [solution.error for _, solution in around if solution is not None],
    )
    refined = solve(float(np.exp(ratio)))
    if refined is not None and better(best, refined) is refined:
        return FocalResult(float(np.exp(ratio)), refined, determined=True)
    return FocalResult(found[best_index][0], best, determined=True)


def _parabola_minimum(positions: Sequence[float], values: Sequence[float]) -> float:
    """Where the parabola through three points, the middle one lowest, is lowest."""
    (x0, x1, x2), (y0, y1, y2) = positions, values
    left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    curvature = (right - left) / (x2 - x0)
    if curvature <= 0:
        return x1
    return float(np.clip((x0 + x1) / 2 - left / (2 * curvature), x0, x2))
