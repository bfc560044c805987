"""The stage `align`: pairwise pointmaps to one world, and one coloured cloud."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageConfig, StageContext


class AlignConfig(StageConfig):
    """Settings of the stage `align`."""

    refine_poses: Literal["auto", "on", "off"] = Field(
        "auto",
        description="Optimise the cameras against the pointmaps: auto does so only where there are "
        "none yet; on: also cameras that an earlier stage gave; off: keep the start.",
    )
    iterations: int = Field(
        300, ge=0, le=100_000, description="Steps of the global alignment (Adam)."
    )
    learning_rate: float = Field(
        0.01, gt=0, le=1, description="At the start; falls to 1e-6 along a cosine."
    )
    refine_learning_rate: float = Field(
        0.001, gt=0, le=1, description="The same, where given cameras are refined."
    )
    samples: int = Field(
        3000, ge=100, le=10_000_000, description="Pixels per view in the global alignment."
    )
    free_focals: bool = Field(
        True, description="Optimise focal lengths too (only where there were no cameras)."
    )
    fill_confidence: float = Field(
        1.25, ge=1,
        description="Depths of no more confidence count as fill: used where nothing better is.",
    )  # fmt: skip
    fill_stride: int = Field(
        3, ge=1, le=64, description="Of the fill, one pixel in so many (in x and y) is taken."
    )
    relative_depth: float = Field(
        0.01, gt=0, le=0.5,
        description="Relative depth difference within which two views see the same surface.",
    )  # fmt: skip
    front: float = Field(
        0.02, gt=0, le=1,
        description="A depth this share in front of what other views see there is refuted.",
    )  # fmt: skip
    min_agreeing: int = Field(
        0, ge=0, le=100, description="Other views that must agree with a point."
    )
    merge: bool = Field(
        True,
        description="Drop a pixel that a more confident view explains (co-visibility pruning).",
    )


class AlignStage(Stage):
    """Bring all pointmaps into one world and fuse them."""

    name = "align"
    version = 1
    summary = "pairwise pointmaps to one world: cameras and one dense coloured cloud"
    Config = AlignConfig
    requires = ("views", "pointmaps")
    optional = ("cameras",)
    provides = ("cameras", "points")
    libraries = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "torch", "kornia")

    def run(self, context: StageContext) -> None:
        import numpy as np

        from pipeline.artifacts.cameras import Cameras
        from pipeline.artifacts.points import Points
        from stages.align.depths import view_depths
        from stages.align.fusion import FusionOptions, fuse
        from stages.align.start import start_from_cameras, start_from_tree
        from stages.align.world import move_camera, normalising_similarity

        config: AlignConfig = context.config
        views = context.load("views")
        by_name = views.by_name()
        pairs = [
            pair
            for pair in context.load("pointmaps")
            if pair.name_i in by_name and pair.name_j in by_name
        ]
        if not pairs:
            raise ReconstructionError(
                "There are no pointmaps of these photographs: no two of them could be matched. "
                "Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        pairs = [_checked(pair, by_name) for pair in pairs]
        given = context.load("cameras") if context.has("cameras") else None
        context.progress("start", 0, 1, pairs=len(pairs))
        if given is None or len(given) == 0:
            given = None
            start = start_from_tree(pairs)
            refine = config.refine_poses != "off"
        else:
            start = start_from_cameras(pairs, given.by_name())
            refine = config.refine_poses == "on"
        figures: dict[str, float | int] = {}
        if refine and config.iterations and start.cameras:
            from stages.align.optimise import AlignOptions, optimise

            options = AlignOptions(
                iterations=config.iterations,
                learning_rate=config.learning_rate
                if given is None
                else config.refine_learning_rate,
                samples=config.samples,
                free_focals=config.free_focals and given is None,
            )
            start, residual = optimise(
                pairs, start, options,
                lambda done, total, loss: context.progress("align", done, total, residual=loss),
            )  # fmt: skip
            figures["alignment_residual"] = round(residual, 5)
        merged = view_depths(pairs, start)
        if len(merged) < 2:
            raise ReconstructionError(
                "The pointmaps do not connect two views: nowhere do two photographs agree on a "
                "surface. Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        names = [view.name for view in views.views if view.name in merged]
        missing = [view.name for view in views.views if view.name not in start.cameras]
        if missing:
            context.warn(f"not placed in the scene: view {', '.join(missing)}")
        masked = {
            name: np.where(by_name[name].valid(), merged[name].confidence, np.float32(1))
            for name in names
        }
        cloud = fuse(
            [merged[name].depth for name in names],
            [masked[name] for name in names],
            [by_name[name].image for name in names],
            [start.cameras[name] for name in names],
            FusionOptions(
                config.fill_confidence, config.fill_stride, config.relative_depth, config.front,
                config.min_agreeing, config.merge,
            ),
            context.threads,
            lambda done, total: context.progress("fuse", done, total),
        )  # fmt: skip
        if len(cloud) == 0:
            raise ReconstructionError(
                "No part of the scene is seen alike by two photographs, so there is no surface to "
                "show. Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        placed = [start.cameras[v.name] for v in views.views if v.name in start.cameras]
        positions, normals = cloud.positions, cloud.normals
        if given is None:
            motion = normalising_similarity(placed, positions)
            placed = [move_camera(camera, motion) for camera in placed]
            moved = motion[0] * positions.astype(np.float64) @ motion[1].T + motion[2]
            positions = moved.astype(np.float32)
            normals = (normals @ motion[1].T).astype(np.float32)
            cameras = Cameras(tuple(placed))
        else:
            cameras = Cameras(tuple(placed), given.input_from_world, given.units)
        context.save(cameras)
        context.save(
            Points(
                positions, cloud.colors, normals, cloud.confidence,
                np.zeros(len(cloud), np.float32),
            )
        )  # fmt: skip
        if np.isfinite(cloud.residual):
            figures["depth_residual_percent"] = round(100 * cloud.residual, 3)
        context.summarize(
            points=len(cloud), fill_points=cloud.fill, views=len(placed),
            views_total=len(views), **figures,
        )  # fmt: skip


def _checked(pair, by_name):  # type: ignore[no-untyped-def]
    """Refuse pointmaps whose size is not that of their view."""
    from pipeline.errors import RequestError

    for name, confidence in ((pair.name_i, pair.confidence_i), (pair.name_j, pair.confidence_j)):
        view = by_name[name]
        if confidence.shape != (view.height, view.width):
            raise RequestError(
                f"The pointmap of the pair {pair.name_i}, {pair.name_j} has "
                f"{confidence.shape[1]}x{confidence.shape[0]} pixels for view {name}, whose image "
                f"is {view.width}x{view.height}. Give pointmaps at the working size, or set "
                "views.long_side to theirs."
            )
    return pair
