"""Conjugate gradients on damped normal equations, for each channel by itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.fit.arrays import Array, Floats

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


def _products(a: Floats, b: Floats) -> Array:
    """[3] scalar products, channel by channel."""
    return np.asarray(np.einsum("nc,nc->c", a, b, dtype=np.float64))
