"""What dense stereo can be told, and what it gives back. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

METHODS = ("sweep", "sgbm")


@dataclass(frozen=True)
class DenseOptions:
    """Settings of `dense_depths`.

    Attributes:
        method: ``"sweep"`` (plane sweep) or ``"sgbm"`` (rectified pairs: a quick preview).
        planes: least number of depth hypotheses per view.
        max_planes: most; between the two a step moves the match by .75 px in the farthest source.
        max_volume: pixels times planes that one cost volume may have; two volumes of 4 bytes each
            are in memory at a time. Large images get fewer planes, down to 16.
        window: side of the matching window in pixels, odd.
        p1, p2: semi-global penalties for a change by one plane, and by more.
        sources: views that each view is compared with.
        min_ncc: least correlation of a depth that is kept.
        relative_depth: how well views must agree.
        min_agreeing: views that must agree; 0: one, two from 6 views on, three from 12 on.
        speckle: islands of fewer pixels are dropped.
        polish: passes of PatchMatch with slanted windows after the sweep; 0: none.
        polish_window: side of its window in pixels, odd.
        fill: complete the depth where stereo knows nothing.
    """

    method: str = "sweep"
    planes: int = 64
    max_planes: int = 192
    max_volume: int = 64_000_000
    window: int = 5
    p1: float = 0.08
    p2: float = 2.0
    sources: int = 4
    min_ncc: float = 0.5
    relative_depth: float = 0.01
    min_agreeing: int = 0
    speckle: int = 30
    polish: int = 0
    polish_window: int = 7
    fill: bool = True


@dataclass(frozen=True)
class DenseView:
    """The surface that one view sees.

    Attributes:
        depth: [H, W] float32 z-depth; 0 where stereo found none.
        confidence: [H, W] float32. Where there is depth: 1 + exp(s), see `confidence_of`. Where
            only `filled` knows: 1.01 to 1.2, less with the distance to known depth. Exactly 1
            where nothing is known.
        normal: [H, W, 3] float32 unit vectors in the world, facing the camera; 0 where neither
            depth nor fill is.
        filled: [H, W] float32: `depth` completed smoothly, backdrop pushed back; 0 outside the
            mask and where the completion would hide what another view sees.
    """

    depth: Array
    confidence: Array
    normal: Array
    filled: Array
