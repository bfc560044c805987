"""Downsampling to a number of points, without letting the backdrop eat them or vanish."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.cloud import median_spacing
from stages.sap.downsample import Cloud, voxel_downsample, voxel_size_for


@dataclass(frozen=True)
class Reduction:
    """What `reduce_cloud` did.

    Attributes:
        cloud: the reduced points; well-known ones first, then the fill.
        fill: how many of them are fill, at the end.
    """

    cloud: Cloud
    fill: int


def reduce_cloud(
    cloud: Cloud,
    voxel_size: float,
    target_points: int,
    fill_confidence: float,
    fill_share: float,
    threads: int,
) -> Reduction:
    """Voxel downsampling of well-known points and of low-confidence fill, each by itself.

    Both get voxels of `voxel_size` median nearest-neighbour spacings of the well-known points. Of
    a budget, the fill gets what it would take by itself, but at most `fill_share`, or what the
    well-known points leave if that is more; its voxels only grow.

    Args:
        cloud: N points.
        voxel_size: voxel edge in median spacings; 0: no voxels but those that the budget needs.
        target_points: budget; 0: none.
        fill_confidence: points of no more confidence are fill (completed depth, backdrop).
        fill_share: largest share of the budget that fill takes from well-known points.
        threads: of the neighbour search; does not change the result.

    Returns:
        A `Reduction`.
    """
    is_fill = cloud.confidence <= fill_confidence
    known, fill = cloud[~is_fill], cloud[is_fill]
    spacing = median_spacing((known if len(known) > 1 else fill).positions, threads)
    known_budget = fill_budget = None
    if target_points:
        # A share of at most all that is there: with no fill, or nothing else, nobody goes short.
        proportional = int(target_points * len(fill) / max(len(cloud), 1))
        capped = min(proportional, int(target_points * fill_share))
        fill_budget = max(capped, target_points - len(known)) if len(fill) else 0
        fill_budget = min(fill_budget, target_points)
        known_budget = target_points - min(fill_budget, len(fill))
    known, voxel = _thin(known, voxel_size * spacing, known_budget, spacing)
    fill, _ = _thin(fill, max(voxel_size * spacing, voxel), fill_budget, spacing)
    joined = Cloud(
        *(
            np.concatenate([getattr(known, name), getattr(fill, name)])
            for name in ("positions", "colors", "normals", "confidence")
        )
    )
    return Reduction(joined, len(fill))


def _thin(cloud: Cloud, size: float, budget: int | None, spacing: float) -> tuple[Cloud, float]:
    """Downsample with voxels of `size`, or larger if `budget` (None: there is none) needs it."""
    if len(cloud) == 0 or budget == 0:
        return cloud[:0], 0.0
    if budget is not None:
        size = max(size, voxel_size_for(cloud.positions, budget, spacing))
    return (voxel_downsample(cloud, size), size) if size > 0 else (cloud, 0.0)
