"""How far apart the points of a cloud lie: 3DGS's first scale."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float32]

#: Least squared distance (3DGS) where the typical one is 1, as worlds have any unit: doubled points
#: must not get scale zero.
MIN_SQUARED_DISTANCE = 1e-7


def point_scales(positions: npt.NDArray[np.floating], threads: int = 1) -> Array:
    """Scale of each point as 3DGS initialises it.

    sigma = sqrt(mean of the squared distances to the 3 nearest neighbours), the mean at least
    1e-7 of the median one (Kerbl et al., "3D Gaussian Splatting", section 5).

    Args:
        positions: [N, 3] world points.
        threads: of the search; does not change the result.

    Returns:
        [N] float32 in world units. With fewer than 4 points, the neighbours that there are count;
        a single point, and those that all lie in one place, get sqrt(1e-7).
    """
    count = len(positions)
    neighbours = min(3, count - 1)
    if neighbours < 1:
        return np.full(count, np.sqrt(MIN_SQUARED_DISTANCE), np.float32)
    points = np.asarray(positions, np.float64)
    distance, _ = cKDTree(points).query(points, k=neighbours + 1, workers=max(threads, 1))
    squared = (distance[:, 1:] ** 2).mean(axis=1)
    apart = squared[squared > 0]
    least = MIN_SQUARED_DISTANCE * (np.median(apart) if len(apart) else 1)
    return np.sqrt(np.maximum(squared, least)).astype(np.float32)
