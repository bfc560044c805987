"""Settings of the stage `init`. Imports nothing heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from pipeline.artifacts.dental.fdi import ALL_TEETH, THE_NUMBERS
from pipeline.stage import StageConfig, runtime
from pipeline.untrusted.paths import GivenPath, user_path
from stages.init.dental.surface.options import SurfaceOptions
from stages.pointmaps.options import PointmapOptions
from stages.stereo.options import DenseOptions

#: Defaults are said once, where they were measured.
DENSE = DenseOptions()
SURFACE = SurfaceOptions()
POINTMAPS = PointmapOptions()

#: The setting that names cameras known beforehand, for messages.
CAMERAS = "init.cameras"


class DenseConfig(StageConfig):
    """Dense stereo."""

    method: Literal["auto", "sweep", "sgbm"] = Field(
        "auto",
        description="sweep: plane sweep with semi-global matching; sgbm: a quick preview for near "
        "views; auto: sweep, or the surface of the teeth where init.cameras are given and few wide "
        "photographs show teeth",
    )
    planes: int = Field(
        DENSE.planes, ge=8, le=512, description="least number of depths tried per pixel"
    )
    max_planes: int = Field(
        DENSE.max_planes, ge=8, le=1024, description="largest number of depths tried"
    )
    window: int = Field(
        DENSE.window, ge=3, le=31, description="side of the matching window, px, odd"
    )
    sources: int = Field(
        DENSE.sources, ge=1, le=32, description="views that each view is compared with"
    )
    min_ncc: float = Field(
        DENSE.min_ncc, ge=-1, le=1, description="least correlation of a kept depth"
    )
    relative_depth: float = Field(
        DENSE.relative_depth, gt=0, le=0.5, description="depth agreement, relative"
    )
    min_agreeing: int = Field(
        DENSE.min_agreeing, ge=0, le=32, description="views that must agree; 0: automatic"
    )
    max_volume: int = Field(
        DENSE.max_volume, ge=1_000_000, description="pixels times depths that are in memory at once"
    )
    polish: int = Field(
        DENSE.polish, ge=0, le=20, description="passes of PatchMatch after the sweep; 0: none"
    )
    polish_window: int = Field(
        DENSE.polish_window, ge=3, le=31, description="side of its window, px, odd"
    )
    fill: bool = Field(DENSE.fill, description="complete the depth where stereo knows nothing")

    @field_validator("window", "polish_window")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise PydanticCustomError("odd", "a window with a pixel in its middle is odd")
        return value


class RefinementConfig(StageConfig):
    """The last adjustment of cameras from features, and what is tried where it fails."""

    refine_distortion: Literal["auto", "always", "never"] = Field(
        "auto", description="estimate a radial coefficient per lens; auto: where it helps clearly"
    )
    unroll: bool = Field(True, description="where links are missing, look for rolled photographs")


class PointmapConfig(StageConfig):
    """Pointmaps of a learned model, or made elsewhere."""

    checkpoint: GivenPath | None = runtime(
        None, description="the model's weights, a file or folder; nothing is ever downloaded"
    )
    package: str | None = Field(None, description="Python package, if not the model's usual one")
    package_folder: GivenPath | None = runtime(
        None, description="a checkout to import the package from, if it is not installed"
    )
    files: GivenPath | None = runtime(
        None, description="folder of .npz pointmaps, for method files"
    )
    file_names: Literal["auto", "source", "neutral"] = Field(
        "auto", description="what their names say: photographs' file names, or 000, 001, ..."
    )
    device: str = Field("auto", description="auto (CUDA if there), cpu, cuda, cuda:1, ...")
    long_side: int = Field(
        POINTMAPS.long_side, ge=64, le=4096, description="image size for dust3r, mast3r, must3r"
    )
    graph: Literal["auto", "complete", "window", "star"] = Field(
        "auto", description="pairs: all, each view with the next ones, or all with one"
    )
    complete_up_to: int = Field(
        POINTMAPS.complete_up_to, ge=2, le=1000, description="views up to which auto takes all"
    )
    window: int = Field(POINTMAPS.window, ge=1, le=1000, description="next views to pair with")
    reference: int | None = Field(None, ge=0, description="centre of a star; null: the middle one")
    symmetric: bool = Field(True, description="ask pairwise models in both orders")
    max_memory_gb: float | None = runtime(
        None, gt=0, description="refuse to start above this; null: what is free"
    )
    edge_jump: float = Field(
        POINTMAPS.edge_jump, gt=0, le=1, description="relative distance between two surfaces"
    )

    @property
    def paths(self) -> dict[str, Path | None]:
        """The fields that are paths of the user's."""
        names = ("checkpoint", "package_folder", "files")
        given = {name: getattr(self, name) for name in names}
        return {
            name: user_path(path, f"init.pointmap.{name}") if path else None
            for name, path in given.items()
        }


def _is_tooth(number: int) -> int:
    if number not in ALL_TEETH:
        why = f"it is no tooth's number; {THE_NUMBERS}"
        raise PydanticCustomError("tooth", "{why}", {"why": why})
    return number


ToothNumber = Annotated[int, AfterValidator(_is_tooth)]


class ToothConfig(StageConfig):
    """The number of one tooth, as a person knows it."""

    photo: str = Field(description="file name of the photograph")
    x: float = Field(description="a point on the crown, pixels of that photograph (upright)")
    y: float = Field(description="a point on the crown, pixels of that photograph (upright)")
    tooth: ToothNumber = Field(description="its FDI number")


class DentalConfig(StageConfig):
    """Wide photographs of teeth: the teeth are the landmarks."""

    order: tuple[Literal["right", "frontal", "left", "between"], ...] | None = Field(
        None,
        min_length=1,
        description="what each photograph shows, in the order of the file names: right or left "
        "buccal, frontal, between; null: found out",
    )
    labels: GivenPath | tuple[ToothConfig, ...] = Field(
        (),
        description="what a person says of the teeth: a file as the page check.html saves it, or "
        "a list of teeth whose number is known; teeth.yaml in the workspace is used by itself",
    )
    tooth_widths: dict[ToothNumber, Annotated[float, Field(gt=2, lt=20)]] = Field(
        {}, description="known mesiodistal widths in mm by FDI number, for the scale"
    )
    accept_doubtful: bool = Field(
        False, description="go on with a doubtful result; the doubts become warnings"
    )
    gum_height: float | None = Field(
        None, ge=0, le=40,
        description="gum shown beyond the crowns, mm; null: 4, or 20 where init.cameras are given",
    )  # fmt: skip
    cloud_spacing: float = Field(
        SURFACE.cloud_spacing, ge=0.03, le=2, description="distance of the points, mm"
    )
    chart_density: float = Field(
        SURFACE.chart_density, ge=4, le=30, description="samples per mm of the dense surface"
    )
    mask_rest: bool | None = Field(
        None,
        description="mask what is not teeth or gum: gloves, lips, retractors; null: unless "
        "init.cameras are given",
    )
    complete_depth: bool = Field(
        True,
        description="where stereo measures three photographs of teeth, the shape of crowns "
        "completes what it does not see",
    )
    wide_angle: float = Field(
        30.0, ge=0, le=180,
        description="init.cameras given: where neighbouring views (3 to 12, of teeth) are further "
        "apart than this, degrees, the teeth's own surface is made instead of the sweep's",
    )  # fmt: skip

    @field_validator("order", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",")) if isinstance(value, str) else value


class LengthConfig(StageConfig):
    """A length that is known, such as the width of a tooth, to give the scene its scale."""

    mm: float | None = Field(None, gt=0, le=100_000, description="the length in millimetres")
    photo: str = Field("", description="file name of the photograph that shows it")
    start: tuple[float, float] = Field(
        (0, 0), description="where it begins, x and y in pixels of that photograph (upright)"
    )
    end: tuple[float, float] = Field((0, 0), description="where it ends")

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.mm is not None and (not self.photo or self.start == self.end):
            raise PydanticCustomError(
                "length", "it needs init.length.photo, init.length.start and init.length.end too"
            )
        return self


class InitConfig(StageConfig):
    """How cameras and first points are found."""

    method: Literal[
        "auto", "known", "colmap", "dental",
        "dust3r", "mast3r", "must3r", "vggt", "mapanything", "files",
    ] = Field("auto", description="how to find the cameras")  # fmt: skip
    cameras: GivenPath | None = runtime(
        None,
        description="cameras that are known: folder of a COLMAP model, or a transforms.json; the "
        "poses and lenses are taken as they are",
    )
    points: Literal["dense", "model"] = Field(
        "dense",
        description="first points: dense stereo; or, with the cameras of a COLMAP model, the "
        "sparse points of that model as they are (align then keeps them)",
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
    squeezes: tuple[Annotated[float, Field(ge=0.1, le=1)], ...] = Field(
        (1.0, 0.71, 0.5), min_length=1, max_length=8,
        description="horizontally squeezed copies of the image that features are taken from; but "
        "1 only where a view is linked to less than two others without them",
    )  # fmt: skip
    upright: bool = Field(True, description="features without orientation: photos not rolled")
    peak_threshold: float = Field(0.002, gt=0, le=0.1, description="SIFT contrast threshold")
    max_features: int = Field(6000, ge=100, le=50_000, description="features per copy")
    match_ratio: float = Field(0.88, gt=0, le=1, description="ratio test: best over next match")
    window: int = Field(4, ge=1, le=1000, description="neighbours in a video that are tried")
    max_error: float = Field(2.0, gt=0, le=50, description="epipolar error, px at 512 px width")
    min_inliers: int = Field(25, ge=8, le=10_000, description="least agreeing matches of a pair")
    min_evidence: float = Field(
        65, ge=1, description="agreeing matches times the square of the share that moves together, "
        "which a pair needs to link photographs; lower risks wrong scenes",
    )  # fmt: skip
    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="COLMAP's mapper; auto: incremental, global where views are left out"
    )
    max_reprojection_error: float = Field(
        2.0, ge=0.1, le=50, description="beyond it an observation is dropped, px at 512 px width"
    )
    min_tri_angle: float = Field(1.0, gt=0, le=45, description="least triangulation angle, degrees")
    refinement: RefinementConfig = Field(
        RefinementConfig.model_validate({}), description="the last adjustment; rolled photographs"
    )
    max_points: int = Field(400_000, ge=1000, le=20_000_000, description="points kept at most")
    match_pictures: int = Field(
        12, ge=0, le=1000, description="pairs of photographs drawn with their matches; 0: none"
    )
    pointmap: PointmapConfig = Field(
        PointmapConfig.model_validate({}), description="learned models and pointmap files"
    )
    dental: DentalConfig = Field(
        DentalConfig.model_validate({}), description="wide photographs of teeth"
    )
    dense: DenseConfig = Field(DenseConfig.model_validate({}), description="dense stereo")
