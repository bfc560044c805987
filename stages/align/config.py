"""Settings of the stage `align`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.stage import StageConfig


class AlignConfig(StageConfig):
    """Settings of the stage `align`."""

    refine: Literal["auto", "always", "never"] = Field(
        "auto",
        description="Optimise the cameras against the pointmaps: auto does so where there are none "
        "yet, or only provisional ones; always: also known cameras and those that an earlier "
        "stage has optimised; never: keep the start.",
    )
    hold_poses: bool = Field(
        False, description="Poses stay as given; focal lengths and scales are optimised."
    )
    hold_focals: Literal["auto", "always", "never"] = Field(
        "auto", description="Focal lengths stay; auto: where the photographs' EXIF data say them."
    )
    shared_focal: Literal["auto", "always", "never"] = Field(
        "auto",
        description="One focal length, relative to the long side, for all photographs; auto: for "
        "the frames of a video and photographs numbered like them.",
    )
    iterations: int = Field(
        30, ge=0, le=10_000, description="Steps of the global alignment at most."
    )
    samples: int = Field(
        3000, ge=100, le=10_000_000, description="Pixels per view in the global alignment."
    )
    matches: Literal["auto", "always", "never"] = Field(
        "auto",
        description="Refine the cameras by bundle adjustment of image features that the pointmaps "
        "help to match; auto: where the cameras come from pointmaps alone.",
    )
    match_features: int = Field(
        3000, ge=100, le=100_000, description="Features per view for that, at most."
    )
    match_min: int = Field(
        80,
        ge=8,
        le=3000,
        description="With fewer matches in any view, the cameras stay as they are.",
    )
    fill_confidence: Annotated[float, Field(ge=1)] | Literal["auto"] = Field(
        "auto",
        description="Depths of no more confidence count as fill: used where nothing better is. "
        "auto: 1.25; 1, which is none, of up to 5 photographs of a mouth near each other.",
    )  # fmt: skip
    relative_depth: float = Field(
        0.01, gt=0, le=0.5,
        description="Relative depth difference within which two views see the same surface.",
    )  # fmt: skip
    front: float = Field(
        0.02, gt=0, le=1,
        description="A depth this share in front of what other views see there is refuted.",
    )  # fmt: skip
    min_agreeing: int = Field(
        0,
        ge=0,
        le=100,
        description="Other views that must agree with a point (all, where there are fewer).",
    )
    merge: bool = Field(
        True,
        description="Drop a pixel that a more confident view explains (co-visibility pruning).",
    )

    @model_validator(mode="after")
    def _check(self) -> AlignConfig:
        if self.matches == "always" and self.hold_poses:
            raise ValueError("matches=always moves poses, and hold_poses holds them")
        return self
