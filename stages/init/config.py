"""Settings of the stage `init`. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.stage import StageConfig, runtime
from stages.init.dense.options import DenseOptions

#: Dense stereo's defaults are said once, where they were measured.
DENSE = DenseOptions()


class DenseConfig(StageConfig):
    """Dense stereo."""

    method: Literal["sweep"] = Field("sweep", description="plane sweep with semi-global matching")
    planes: int = Field(
        DENSE.planes, ge=8, le=512, description="least number of depths tried per pixel"
    )
    max_planes: int = Field(
        DENSE.max_planes, ge=8, le=1024, description="largest number of depths tried"
    )
    step_px: float = Field(
        DENSE.step_px, gt=0, le=8, description="shift of a match from depth to depth, px"
    )
    window: int = Field(
        DENSE.window, ge=3, le=31, description="side of the matching window, px, odd"
    )
    p1: float = Field(DENSE.p1, ge=0, le=10, description="penalty for a depth change by one step")
    p2: float = Field(DENSE.p2, ge=0, le=100, description="penalty for a larger depth change")
    sources: int = Field(
        DENSE.sources, ge=1, le=32, description="views that each view is compared with"
    )
    best_angle: float = Field(
        DENSE.best_angle, gt=0, le=90, description="triangulation angle wanted, degrees"
    )
    min_angle: float = Field(
        DENSE.min_angle, ge=0, le=90, description="least angle to a source view, degrees"
    )
    max_angle: float = Field(
        DENSE.max_angle, gt=0, le=120, description="largest angle to a source, degrees"
    )
    range_margin: float = Field(
        DENSE.range_margin, ge=0, le=5, description="share added to the depth range"
    )
    min_ncc: float = Field(
        DENSE.min_ncc, ge=-1, le=1, description="least correlation of a kept depth"
    )
    relative_depth: float = Field(
        DENSE.relative_depth, gt=0, le=0.5, description="depth agreement, relative"
    )
    reprojection_px: float = Field(
        DENSE.reprojection_px, gt=0, le=20, description="agreement in the image, px"
    )
    min_agreeing: int = Field(
        DENSE.min_agreeing, ge=0, le=32, description="views that must agree; 0: automatic"
    )
    front: float = Field(
        DENSE.front, gt=0, le=1, description="depths this far in front are refuted"
    )
    min_variance: float = Field(
        DENSE.min_variance, ge=0, le=1, description="grey variance below which nothing is matched"
    )
    max_volume: int = Field(
        DENSE.max_volume, ge=1_000_000, description="pixels times depths that are in memory at once"
    )
    speckle: int = Field(
        DENSE.speckle, ge=0, le=100_000, description="smaller islands are dropped, pixels"
    )
    mask_highlights: bool = Field(
        DENSE.mask_highlights, description="keep highlights out of the matching"
    )
    fill: bool = Field(DENSE.fill, description="complete the depth where stereo knows nothing")
    fill_reach_px: float = Field(
        DENSE.fill_reach_px, gt=0, le=4096, description="reach of known depth into holes"
    )


class LengthConfig(StageConfig):
    """A length that is known, such as the width of a tooth, to give the scene its scale."""

    mm: float | None = Field(None, gt=0, le=100_000, description="the length in millimetres")
    photo: str = Field("", description="file name of the photograph that shows it")
    start: tuple[float, float] = Field(
        (0, 0), description="where it begins, x and y in pixels of that photograph (upright)"
    )
    end: tuple[float, float] = Field((0, 0), description="where it ends")


class InitConfig(StageConfig):
    """How cameras and first points are found."""

    method: Literal["auto", "colmap", "dental", "known"] = Field(
        "auto", description="how to find the cameras"
    )
    cameras: str | None = runtime(
        None,
        description="cameras that are known: folder of a COLMAP model, or a transforms.json; the "
        "poses and lenses are taken as they are",
    )
    units: Literal["auto", "mm", "arbitrary"] = Field(
        "auto", description="units of the known cameras; auto: as their file says"
    )
    length: LengthConfig = Field(
        LengthConfig.model_validate({}), description="a known length, for the scale"
    )
    focal: float | None = Field(
        None, ge=0.2, le=20,
        description="focal length over the long side of the image, if known (35 mm equivalent / "
        "36); overrides EXIF; null: EXIF, else searched",
    )  # fmt: skip
    refine_focal: Literal["auto", "always", "never"] = Field(
        "auto",
        description="free the focal length in bundle adjustment; auto: from 3 views, if not given",
    )
    min_views_fraction: float = Field(
        0.5, ge=0, le=1, description="share of the views that must be placed (of 3: all)"
    )
    squeezes: tuple[float, ...] = Field(
        (1.0, 0.71, 0.5), min_length=1, max_length=8,
        description="horizontally squeezed copies of the image that features are taken from",
    )  # fmt: skip
    upright: bool = Field(True, description="features without orientation: photos not rolled")
    peak_threshold: float = Field(0.002, gt=0, le=0.1, description="SIFT contrast threshold")
    max_features: int = Field(6000, ge=100, le=50_000, description="features per copy")
    merge_radius: float = Field(1.2, ge=0, le=10, description="features this near are one, px")
    match_ratio: float = Field(0.88, gt=0, le=1, description="ratio test: best over next match")
    overlap_features: int = Field(800, ge=50, le=20_000, description="features per overlap test")
    overlap_matches: int = Field(80, ge=1, description="overlap from which plain features do")
    pairs_per_view: int = Field(6, ge=1, le=1000, description="pairs matched fully, per view")
    window: int = Field(4, ge=1, le=1000, description="neighbours in a video that are tried")
    max_error: float = Field(2.0, gt=0, le=50, description="epipolar error, px at 512 px width")
    min_inliers: int = Field(25, ge=8, le=10_000, description="least agreeing matches of a pair")
    min_evidence: float = Field(
        65, ge=1, description="agreeing matches times the square of the share that moves together, "
        "which a pair needs to link photographs; lower risks wrong scenes",
    )  # fmt: skip
    cycle_angle: float = Field(8.0, gt=0, le=180, description="rotation error around a cycle, deg")
    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="COLMAP's mapper; auto: incremental, global where views are left out"
    )
    max_reprojection_error: float = Field(
        2.0, gt=0, le=50, description="beyond it an observation is dropped, px at 512 px width"
    )
    min_tri_angle: float = Field(1.0, ge=0, le=45, description="least triangulation angle, degrees")
    max_points: int = Field(400_000, ge=1000, le=20_000_000, description="points kept at most")
    fill_step: int = Field(
        4, ge=0, le=64, description="every n-th pixel without stereo depth is filled in; 0: none"
    )
    min_dense_points: int = Field(
        5000, ge=0, description="with fewer dense points the sparse ones are added"
    )
    dense: DenseConfig = Field(DenseConfig.model_validate({}), description="dense stereo")
