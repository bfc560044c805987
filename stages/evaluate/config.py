"""Settings of the `evaluate` stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.stage import StageConfig, runtime
from pipeline.untrusted.paths import GivenPath

Channel = Annotated[float, Field(ge=0, le=1)]
Distance = Annotated[float, Field(gt=0)]


class EvaluateConfig(StageConfig):
    """Settings of the evaluate stage."""

    background: tuple[Channel, Channel, Channel] | None = Field(
        None, description="Colour behind the scene, RGB in 0..1; null: the scene's own."
    )
    comparisons: bool = Field(
        True, description="Write comparison_<view>.png: photograph | render | error."
    )
    max_comparisons: int = Field(
        24, ge=1, le=1000, description="At most so many comparison pictures, spread over the views."
    )
    save_renders: bool = Field(False, description="Also write render_<view>.png of every view.")
    ground_truth: GivenPath | None = runtime(
        None,
        description="True cameras of the photographs, input and held out, by file name: a "
        "transforms.json or the folder of a COLMAP model. Its contents count, not its place.",
    )
    mesh: GivenPath | None = runtime(
        None, description="True surface (.ply, .stl or .obj) in the world of the ground truth."
    )
    masks: GivenPath | None = runtime(
        None,
        description="Folder of masks for scoring, named as the photographs, 255 where the figures "
        "with `_mask` (and the geometry) count, such as on teeth.",
    )
    test_poses: Literal["registered", "refined", "both"] = Field(
        "both",
        description="Cameras of held-out photographs: registered by the ground truth alone, or "
        "then refined photometrically with the scene as it is.",
    )
    lpips_weights: GivenPath | None = runtime(
        None,
        description="torchvision's VGG-16 weights (.pth or .safetensors) for LPIPS; default: those "
        "in torch's cache. Without any, lpips is null.",
    )
    flip: bool = Field(True, description="Compute FLIP as well (0.2 s a picture).")
    support_pictures: bool = Field(
        True, description="Write support_<view>.png: tinted where no photograph saw the scene."
    )
    novel_angle: float = Field(
        20.0,
        ge=0,
        le=90,
        description="Also for two novel views, so many degrees beyond the outermost input views; "
        "0: none.",
    )
    align: Literal["cameras", "icp"] = Field(
        "cameras",
        description="How points are laid onto the mesh: by the similarity of the cameras, or then "
        "by ICP as well.",
    )
    geometry_distances: tuple[Distance, ...] = Field(
        (0.5, 1.0),
        min_length=1,
        description="Distances of the F-scores: mm, or percent of the mesh's diagonal where the "
        "ground truth has no units.",
    )
