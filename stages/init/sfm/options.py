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
        refine_distortion: ``"auto"``, ``"always"`` or ``"never"``: estimate one radial coefficient
            per lens; auto: keep it where it lowers the error clearly.
        unroll: where photographs are not linked, find out whether they are rolled.
    """

    refine_distortion: str = "auto"
    unroll: bool = True


@dataclass(frozen=True)
class ClassicalOptions:
    """Settings of `reconstruct`; the stage's config describes each for users."""

    squeezes: tuple[float, ...] = (1.0, 0.71, 0.5)
    upright: bool = True
    peak_threshold: float = 0.002
    max_features: int = 6000
    match_ratio: float = 0.88
    window: int = 4
    max_error: float = 2.0
    min_inliers: int = 25
    min_evidence: float = 65.0
    refine_focal: str = "auto"
    mapper: str = "auto"
    max_reprojection_error: float = 2.0
    min_tri_angle: float = 1.0
