"""Settings of the classical path. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

#: Pixel thresholds are given for images of this long side and scale with it.
REFERENCE_SIDE = 512.0
#: Squeezed copies, and photographs that are asked how they are rolled, have at most this long side:
#: what is still alike from far apart is not the finest detail.
COPIES_SIDE = 640.0
#: Coherence looks at neighbours this near (pixels at the reference size).
COHERENCE_RADIUS = 40.0
#: Bundle adjustment finds a focal length from this many views on (three at 10 to 35 degrees give
#: it within 2 %; two give anything).
VIEWS_PER_FREE_LENS = 3


@dataclass(frozen=True)
class RefinementOptions:
    """Settings of the last adjustment of a reconstruction, and of what is tried where it fails.

    Attributes:
        loss_scale: pixels (at the reference size) of reprojection error from which on an
            observation counts less than squared.
        refine_distortion: ``"auto"``, ``"always"`` or ``"never"``: estimate one radial coefficient
            per lens; auto: keep it where it lowers the error clearly.
        distortion_views: placed views that a lens needs for it.
        distortion_observations: observations that a lens needs for it.
        distortion_gain: share by which the (robust) sum of squared errors must fall. Straight
            lenses gain up to .002, those of phones and compact cameras .08 to .33, and a strong
            barrel that is seen within 10 degrees .015.
        unroll: where photographs are not linked, find out whether they are rolled.
    """

    loss_scale: float = 0.5
    refine_distortion: str = "auto"
    distortion_views: int = 3
    distortion_observations: int = 300
    distortion_gain: float = 0.01
    unroll: bool = True


@dataclass(frozen=True)
class ClassicalOptions:
    """Settings of `reconstruct`; the stage's config describes each for users."""

    squeezes: tuple[float, ...] = (1.0, 0.71, 0.5)
    upright: bool = True
    peak_threshold: float = 0.002
    max_features: int = 6000
    match_ratio: float = 0.88
    overlap_features: int = 800
    overlap_matches: int = 80
    pairs_per_view: int = 6
    window: int = 4
    max_error: float = 2.0
    min_inliers: int = 25
    min_evidence: float = 65.0
    cycle_angle: float = 8.0
    refine_focal: str = "auto"
    mapper: str = "auto"
    max_reprojection_error: float = 2.0
    min_tri_angle: float = 1.0
