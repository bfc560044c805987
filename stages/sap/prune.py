"""Scale-adaptive pruning (DentalSplat, section 3.2).

S is the scale of each point in three equal columns, mu its mean.
M1: max S_i > mu. M2: max S_i > Q_q(S) if N < 5e6, else max S_i > 4 mu.
The paper keeps the points in M1 and M2, which taken literally leaves only the largest 0.1 %; its
text, and the pruning that it builds on, remove them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def oversized(
    scales: npt.NDArray[np.floating],
    quantile: float = 0.999,
    large_count: int = 5_000_000,
    large_factor: float = 4.0,
) -> npt.NDArray[np.bool_]:
    """The mask M1 and M2: points whose spacing is far beyond that of the cloud.

    Args:
        scales: [N] scale of each point (its three columns are the same).
        quantile: q, between 0 and 1.
        large_count: from so many points on, the quantile gives way to a multiple of the mean.
        large_factor: that multiple.

    Returns:
        [N] bool.
    """
    if len(scales) == 0:
        return np.zeros(0, bool)
    values = np.asarray(scales, np.float64)
    mean = values.mean()
    limit = np.quantile(values, quantile) if len(values) < large_count else large_factor * mean
    return np.asarray((values > mean) & (values > limit))


def survivors(
    scales: npt.NDArray[np.floating],
    mode: str,
    quantile: float = 0.999,
    large_count: int = 5_000_000,
    large_factor: float = 4.0,
) -> npt.NDArray[np.bool_]:
    """Points [N] bool that stay: all but the mask (``prune``), the mask (``keep``), all (``off``).

    Raises:
        ValueError: the mode is none of these.
    """
    if mode == "off":
        return np.ones(len(scales), bool)
    mask = oversized(scales, quantile, large_count, large_factor)
    if mode == "keep":
        return mask
    if mode == "prune":
        return ~mask
    raise ValueError(f"unknown pruning mode '{mode}'; there are prune, keep, off")
