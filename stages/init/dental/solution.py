"""Cameras and named teeth, found from the crowns in the photographs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from stages.init.dental.anatomy import Jaw, Landmark

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PlacedView:
    """One photograph, placed.

    Attributes:
        cam_from_world: [4, 4] float64; the world is the arch frame in millimetres: x to the
            patient's left, y up, z towards a camera in front; the origin between the upper central
            incisors' biting edges.
        focal: pixels of the working image; the principal point is its centre.
        role: `right`, `frontal`, `left` (buccal), or `between`.
        upper, lower: FDI number of each crown of the `Dentition`, in its order; 0 where a crown is
            taken for no tooth (a bracket, a glove, a split outline).
        error: median reprojection error of the landmarks in pixels.
    """

    cam_from_world: Array
    focal: float
    role: str
    upper: tuple[int, ...]
    lower: tuple[int, ...]
    error: float

    def teeth(self, jaw: Jaw) -> tuple[int, ...]:
        """FDI numbers of the crowns of one jaw."""
        return self.upper if jaw == "upper" else self.lower


@dataclass(frozen=True)
class ArchFit:
    """The outcome of `fit_arch`.

    Attributes:
        views: one per photograph, in the order given; None where it could not be placed.
        landmarks: seen landmarks -> [3] position in mm (arch frame).
        shape: every landmark of the arch model, seen or not -> [3] position in mm, after fitting.
        margin: by how much the labelling chosen is better than the next one (log evidence).
        doubts: sentences for the user why the result should not be trusted; empty: trust it.
        scale_uncertainty: relative standard deviation of the millimetres.
    """

    views: tuple[PlacedView | None, ...]
    landmarks: dict[Landmark, Array]
    shape: dict[Landmark, Array]
    margin: float
    doubts: tuple[str, ...] = ()
    scale_uncertainty: float = 0.15
    figures: dict[str, float] = field(default_factory=dict)
