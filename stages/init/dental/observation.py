"""What one photograph shows of the teeth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stages.init.dental.anatomy import Jaw

Point = npt.NDArray[np.float64]  # [2] x, y in pixels of the working image, pixel centres at .5


@dataclass(frozen=True)
class Crown:
    """One crown as seen in one photograph. All points are pixels of the working image as it is.

    "Left" and "right" are those of the image after its roll is taken out.

    Attributes:
        jaw: upper or lower.
        zenith: highest point of the gum line (lowest, in the lower jaw).
        tip: middle of the biting edge or cusp, where the crown ends towards the other jaw.
        papilla_left, papilla_right: tips of the gum beside it; None at the ends of the row.
        embrasure_left, embrasure_right: where it parts from its neighbours; None at the ends.
        width, height: pixels, along and across the row.
        cut_left, cut_right: the row ends here, so that the crown may go on unseen.
        doubtful: its outline is weak: too narrow, at the border of the image, merged or split.
    """

    jaw: Jaw
    zenith: Point
    tip: Point
    papilla_left: Point | None
    papilla_right: Point | None
    embrasure_left: Point | None
    embrasure_right: Point | None
    width: float
    height: float
    cut_left: bool = False
    cut_right: bool = False
    doubtful: bool = False


@dataclass(frozen=True)
class Dentition:
    """The teeth in one photograph.

    Attributes:
        upper, lower: crowns from left to right (after the roll is taken out).
        mask: [H, W] bool, True on teeth (of the working image as it is, not turned).
        above: [H, W] bool, True above the line where the jaws meet: where a pixel is tooth, it is
            an upper one.
        roll: radians by which the row of teeth is turned clockwise in the image.
        band_height: pixels from the upper to the lower gum line (median).
        doubts: sentences for the user about what is not as expected; empty where all is well.
    """

    upper: tuple[Crown, ...]
    lower: tuple[Crown, ...]
    mask: npt.NDArray[np.bool_]
    above: npt.NDArray[np.bool_]
    roll: float
    band_height: float
    doubts: tuple[str, ...] = ()

    def crowns(self, jaw: Jaw) -> tuple[Crown, ...]:
        """The crowns of one jaw, from left to right."""
        return self.upper if jaw == "upper" else self.lower
