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
