"""The `evaluate` stage: how close the scene, rendered from each input view, comes to the photo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.metrics import Metrics
from pipeline.artifacts.views import Views, to_uint8, write_png
from pipeline.errors import RequestError
from pipeline.stage import Stage, StageConfig, StageContext

Channel = Annotated[float, Field(ge=0, le=1)]

#: The input views trained the scene, so that their figures say nothing about unseen views.
PROTOCOL = "input views (training views), 8-bit images, registered cameras"


class EvaluateConfig(StageConfig):
    """Settings of the evaluate stage."""

    background: tuple[Channel, Channel, Channel] = Field(
        (0.0, 0.0, 0.0), description="Colour behind the scene, RGB in 0..1."
    )
    comparisons: bool = Field(
        True, description="Write comparison_<view>.png: photograph | render | error."
    )
    max_comparisons: int = Field(
        24, ge=1, le=1000, description="At most so many comparison pictures, spread over the views."
    )
    error_range: float = Field(
        0.25, gt=0, le=1, description="Error (0..1) that has the brightest colour in the pictures."
    )
    save_renders: bool = Field(False, description="Also write render_<view>.png of every view.")


class EvaluateStage(Stage):
    """Views, cameras and Gaussians -> metrics of the input views."""

    name = "evaluate"
    version = 2
    summary = "PSNR and SSIM of the renders against the input photographs, side by side pictures"
    Config = EvaluateConfig
    requires = ("views", "cameras", "gaussians")
    provides = ("metrics",)
    libraries = ("numpy", "numba", "opencv-contrib-python-headless")

    def run(self, context: StageContext) -> None:
        from stages.splatting import render

        evaluate(context, render)


def evaluate(context: StageContext, render: Callable[..., Any]) -> None:
    """Render every placed view, compare, write figures and pictures.

    Args:
        context: of the stage.
        render: (gaussians, camera, background, threads) -> object with `image` [H, W, 3] and
            `alpha` [H, W].

    Raises:
        RequestError: no camera belongs to any of the views.
    """
    from stages.evaluate import pictures
    from stages.evaluate.score import score_view, summary_of

    config: EvaluateConfig = context.config
    views: Views = context.load("views")
    placed_cameras: Cameras = context.load("cameras")
    cameras = placed_cameras.by_name()
    gaussians: Gaussians = context.load("gaussians")
    placed = [view for view in views.views if view.name in cameras]
    unplaced = [view.name for view in views.views if view.name not in cameras]
    if not placed:
        raise RequestError(
            "None of the cameras belongs to one of the views, so there is nothing to compare: the "
            f"views are {', '.join(unplaced)}, the cameras {', '.join(sorted(cameras)) or 'none'}. "
            "Cameras from outside must carry the names of the views."
        )
    folder = context.output("metrics")
    pictured = set(pictures.spread(len(placed), config.max_comparisons))
    figures: dict[str, dict[str, float]] = {}
    without_pixels: list[str] = []
    for index, view in enumerate(placed):
        context.progress("render", index, len(placed), view=view.name)
        valid = view.valid()
        if not valid.any():
            without_pixels.append(view.name)
            continue
        camera = cameras[view.name].resized(view.width, view.height)
        result = render(
            gaussians, camera, background=config.background, threads=context.threads
        )  # fmt: skip
        rendered, photo = to_uint8(np.asarray(result.image)), to_uint8(view.image)
        figures[view.name] = score_view(rendered, photo, np.asarray(result.alpha), valid)
        if config.comparisons and index in pictured:
            picture = pictures.comparison(rendered, photo, config.error_range, view.mask)
            write_png(folder / f"comparison_{view.name}.png", picture)
        if config.save_renders:
            write_png(folder / f"render_{view.name}.png", rendered)
    context.progress("render", len(placed), len(placed))
    if not figures:
        raise RequestError(
            "The masks leave no pixel of any placed view, so there is nothing to compare. Check "
            "that white means 'use this pixel' in your masks."
        )
    if without_pixels:
        context.warn(f"Not scored, because their masks are empty: {', '.join(without_pixels)}.")
    summary = summary_of(figures)
    context.save(
        Metrics(
            {
                "protocol": PROTOCOL,
                "background": list(config.background),
                "gaussians": len(gaussians),
                "views": figures,
                **summary,
                "coverage": summary["mean"]["coverage"],
                "views_unplaced": unplaced,
                "views_without_pixels": without_pixels,
            }
        )
    )
    mean = summary["mean"]
    context.summarize(
        psnr=round(mean["psnr"], 2),
        ssim=round(mean["ssim"], 4),
        coverage=round(mean["coverage"], 4),
        views=f"{len(figures)}/{len(views)}",
    )
