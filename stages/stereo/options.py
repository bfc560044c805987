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
        max_planes: most; between the two the step is `step_px` in the farthest source.
        max_volume: pixels times planes that one cost volume may have; two volumes of 4 bytes each
            are in memory at a time. Large images get fewer planes, down to 16.
        step_px: how far one plane step moves the match, in pixels.
        window: side of the matching window in pixels, odd.
        p1, p2: semi-global penalties for a change by one plane, and by more.
        sources: views that each view is compared with.
        best_angle, min_angle, max_angle: triangulation angles wanted and allowed, degrees.
        range_margin: share of the span of the sparse points' inverse depths added at either end.
        min_ncc: least correlation of a depth that is kept.
        relative_depth, reprojection_px: how well views must agree.
        min_agreeing: views that must agree; 0: one, two from 6 views on, three from 12 on.
        front: a depth this share in front of what other views see there is refuted.
        min_variance: grey variance below which a window counts as textureless.
        speckle: islands of fewer pixels are dropped.
        mask_highlights: keep highlights and saturated pixels out of the matching.
        fill: complete the depth where stereo knows nothing.
        fill_reach_px: how far known depth reaches into a hole.
    """

    method: str = "sweep"
    planes: int = 64
    max_planes: int = 192
    max_volume: int = 64_000_000
    step_px: float = 0.75
    window: int = 5
    p1: float = 0.08
    p2: float = 2.0
    sources: int = 4
    best_angle: float = 12.0
    min_angle: float = 3.0
    max_angle: float = 45.0
    range_margin: float = 0.25
    min_ncc: float = 0.5
    relative_depth: float = 0.01
    reprojection_px: float = 1.5
    min_agreeing: int = 0
    front: float = 0.02
    min_variance: float = 2e-5
    speckle: int = 30
    mask_highlights: bool = True
    fill: bool = True
    fill_reach_px: float = 80.0


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
