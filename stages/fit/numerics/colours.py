"""Conjugate gradients on damped normal equations, channel by channel, and a bound for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from stages.fit.arrays import Array, Floats
from stages.splatting.threads import workers

#: what no photograph shows has no weight to divide by
LEAST = 1e-3


def solved(
    normal: Callable[[Floats], Floats], wanted: Floats, damping: float, steps: int
) -> Floats:
    """x of (A + damping I) x = wanted, as far as some steps come from x = 0.

    Preconditioned by the sums of A's rows (Jacobi's would be its diagonal): where Gaussians
    overlap, that is nearer to what they can change together.

    Args:
        normal: [N, 3] -> A times it; A is symmetric, without negative weights.
        wanted: [N, 3] float32.
        damping: above 0.
        steps: each is one call of `normal`, and there is one more.
    """
    if steps < 1:
        return np.zeros_like(wanted)
    sums = np.maximum(normal(np.ones_like(wanted)), np.float32(LEAST))
    inverse = np.asarray(1 / (sums + np.float32(damping)), np.float32)
    found, rest = np.zeros_like(wanted), wanted.copy()
    direction: Floats = inverse * rest
    now = _products(rest, direction)
    for _ in range(steps):
        applied: Floats = normal(direction) + np.float32(damping) * direction
        length = now / np.maximum(_products(direction, applied), 1e-30)
        found += (length * direction).astype(np.float32)
        rest -= (length * applied).astype(np.float32)
        conditioned: Floats = inverse * rest
        before, now = now, _products(rest, conditioned)
        share = (now / np.maximum(before, 1e-30)).astype(np.float32)
        direction = conditioned + share * direction
    return found


def bounded(
    move: Floats, colours: Floats, positions: Floats, neighbours: int, reach: float
) -> Floats:
    """[N, 3] `move`, cut where it leads to a colour that nothing around has.

    Args:
        move: [N, 3] change of the colours [N, 3].
        positions: [N, 3] of what has them.
        neighbours: colours may move among those that so many of the nearest have now, ...
        reach: ... and so far beyond.
    """
    count = min(neighbours + 1, len(colours))
    if count < 1:
        return move
    _, nearest = cKDTree(positions).query(positions, k=count, workers=workers())
    least, most = colours.copy(), colours.copy()
    for column in nearest.reshape(len(colours), count).T:
        np.minimum(least, colours[column], out=least)
        np.maximum(most, colours[column], out=most)
    margin = np.float32(reach)
    return np.clip(move, least - margin - colours, most + margin - colours)


def deviation(sizes: list[Floats]) -> float:
    """Standard deviation of what is noise in the differences of these sizes.

    By their median, as few pixels lie at edges that a render has in another place.
    """
    every = np.concatenate(sizes)
    return 1.4826 * float(np.median(every)) if len(every) else 0.0


def _products(a: Floats, b: Floats) -> Array:
    """[3] scalar products, channel by channel."""
    return np.asarray(np.einsum("nc,nc->c", a, b, dtype=np.float64))
