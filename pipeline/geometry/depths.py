"""One depth map per view from all pairs that it occurs in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.geometry.start import Start

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ViewDepth:
    """Depth of one view.

    Attributes:
        depth: [H, W] float32 z-depth in its camera, 0 where nothing is known.
        confidence: [H, W] float32 >= 1.
    """

    depth: Array
    confidence: Array


def view_depths(
    pairs: Iterable[PointmapPair], start: Start, same: float = 0.01
) -> dict[str, ViewDepth]:
    """Merge what the pairs say about each placed view.

    Where two pairs agree within `same` (relative), the depth is their mean weighted by log
    confidence; where they don't, the more confident one holds. The confidence is the larger one:
    a view's depth may come in several pairs with the same values, which says nothing new.

    Args:
        pairs: in the order of the start.
        start: cameras and pair similarities.
        same: relative depth difference up to which two pairs say the same.

    Returns:
        By view name, for each placed view that some placed pair contains.
    """
    sums: dict[str, list[npt.NDArray]] = {}
    for pair, motion in zip(pairs, start.pair_from, strict=True):
        if motion is None:
            continue
        scale, rotation, shift = motion
        for name, points, confidence in (
            (pair.name_i, pair.points_i, pair.confidence_i),
            (pair.name_j, pair.points_j_in_i, pair.confidence_j),
        ):
            camera = start.cameras[name]
            # z of cam_from_world (s R P + t), without lifting all three coordinates.
            axis = camera.rotation[2]
            offset = axis @ shift + camera.translation[2]
            z = (scale * (points.astype(np.float64) @ (rotation.T @ axis)) + offset).astype("f4")
            weight = np.where(z > 0, np.log(np.maximum(confidence, 1)), 0).astype(np.float32)
            if name not in sums:
                sums[name] = [np.where(weight > 0, z, 0), weight, weight]
                continue
            depth, mass, best = sums[name]
            agree = (depth > 0) & (np.abs(z - depth) <= same * depth)
            replace = (weight > best) & ~agree
            mean = (mass * depth + weight * z) / np.maximum(mass + weight, 1e-12)
            sums[name] = [
                np.where(agree, mean, np.where(replace, z, depth)).astype(np.float32),
                np.where(agree, mass + weight, np.where(replace, weight, mass)),
                np.maximum(best, weight),
            ]
    return {
        name: ViewDepth(depth, np.exp(best).astype(np.float32))
        for name, (depth, _, best) in sums.items()
    }
