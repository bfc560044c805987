"""Pointmaps at an even grid of pixels: what finding cameras needs of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.pointmaps import PointmapPair

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Side:
    """One view's half of a pair.

    Attributes:
        name: of the view.
        points: [M, 3] float64 in the camera frame of the pair's first view.
        weight: [M] float64, log confidence; 0: nothing known.
    """

    name: str
    points: Array
    weight: Array


@dataclass(frozen=True)
class SampledPair:
    """A pair at the grids of its views, and its worth as an edge (see `pair_score`)."""

    first: Side
    second: Side
    score: float

    @property
    def sides(self) -> tuple[Side, Side]:
        return self.first, self.second


def pair_score(pair: PointmapPair) -> float:
    """Worth of a pair as an edge: mean(conf_i) * mean(conf_j), both above 1 (DUSt3R)."""
    above_i = float(np.mean(pair.confidence_i, dtype=np.float64)) - 1
    above_j = float(np.mean(pair.confidence_j, dtype=np.float64)) - 1
    return above_i * above_j


def grid(height: int, width: int, samples: int) -> tuple[Numbers, Numbers]:
    """Rows and columns of an even grid of about so many pixels."""
    stride = max(1, int(np.ceil(np.sqrt(height * width / samples))))
    return np.arange(stride // 2, height, stride), np.arange(stride // 2, width, stride)


def grid_pixels(height: int, width: int, samples: int, cx: float, cy: float) -> Array:
    """[M, 2] pixels of that grid, from the principal point."""
    rows, columns = grid(height, width, samples)
    v, u = np.meshgrid(rows + 0.5 - cy, columns + 0.5 - cx, indexing="ij")
    return np.stack([u.ravel(), v.ravel()], -1)


def sampled(pairs: Sequence[PointmapPair], samples: int) -> list[SampledPair]:
    """The pairs at grids of about so many pixels per view."""
    return [
        SampledPair(
            _side(pair.name_i, pair.points_i, pair.confidence_i, samples),
            _side(pair.name_j, pair.points_j_in_i, pair.confidence_j, samples),
            pair_score(pair),
        )
        for pair in pairs
    ]


def _side(name: str, points: npt.NDArray, confidence: npt.NDArray, samples: int) -> Side:
    height, width = confidence.shape
    index = np.ix_(*grid(height, width, samples))
    weight = np.log(np.maximum(confidence[index].astype(np.float64), 1.0))
    return Side(name, points[index].reshape(-1, 3).astype(np.float64), weight.ravel())
