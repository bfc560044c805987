"""Settings of the stage `teeth`. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.stage import StageConfig


class TeethConfig(StageConfig):
    """How photographs are read."""

    method: Literal["auto", "reader", "none"] = Field(
        "auto",
        description="reader: read every photograph; none: none; auto: read at most `most_views`, "
        "and nothing where hardly any of these shows teeth",
    )
    most_views: int = Field(
        12,
        ge=1,
        le=1000,
        description="of more photographs than this, auto reads so many, evenly; and of as many "
        "others, if some of these show no teeth, those that do",
    )
    set_aside: bool = Field(
        True,
        description="leave out what is no photograph of closed teeth from the front or side: "
        "occlusal views, open mouths, faces, X-rays, what is shown twice",
    )
    least_crowns: int = Field(
        5, ge=2, le=32, description="with fewer crowns a photograph shows no row of teeth"
    )
    least_extent: float = Field(
        0.3, ge=0, le=1,
        description="a row of teeth narrower than this, over the photograph's long side, is a face",
    )  # fmt: skip
    least_colour: float = Field(
        4.0, ge=0, le=100,
        description="mean chroma (CIE ab) below which a picture has no colour: an X-ray, or, "
        "where all have none, a black-and-white photograph",
    )  # fmt: skip
    least_score: float = Field(
        0.9, ge=0, le=1,
        description="with a lower median score of its crowns, each counting by its area, a "
        "photograph shows something else (clinics' photographs of teeth, braces too: .95 and "
        "more; of houses: .88 at most)",
    )  # fmt: skip
    same_view: float = Field(
        0.02, ge=0, le=1,
        description="two photographs whose crowns lie this near each other after a similarity "
        "transform, over the width of their rows, show the same",
    )  # fmt: skip
