"""The stage `sap`: voxel downsampling and scale-adaptive pruning of the point cloud."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.artifacts.confidence import FILLED
from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageConfig, StageContext


class SapConfig(StageConfig):
    """Settings of the stage `sap`."""

    mode: Literal["prune", "keep", "off"] = Field(
        "prune",
        description="prune: remove the oversized points M1 and M2 (default); keep: keep only them, "
        "the paper's formula to the letter; off: no pruning.",
    )
    quantile: float = Field(
        0.999, gt=0, lt=1,
        description="Q of M2: points whose scale exceeds this quantile of all are oversized.",
    )  # fmt: skip
    large_count: int = Field(
        5_000_000, ge=1, description="From so many points on, M2 is scale > large_factor * mean."
    )
    large_factor: float = Field(
        4.0, gt=0, le=1000, description="Multiple of the mean scale for very large clouds."
    )
    order: Literal["downsample_first", "prune_first"] = Field(
        "downsample_first", description="Which of the two steps comes first."
    )
    voxel_size: float = Field(
        1.0, ge=0, le=1000,
        description="Voxel edge in median nearest-neighbour spacings of the cloud; 0: no voxels "
        "but those that target_points needs.",
    )  # fmt: skip
    target_points: int = Field(
        100_000, ge=0, le=100_000_000,
        description="At most so many points are left: the voxels grow until they are. 0: no limit.",
    )  # fmt: skip
    fill_confidence: float = Field(
        FILLED, ge=1,
        description="Points of no more confidence count as fill (backdrop, completed depth).",
    )  # fmt: skip
    fill_share: float = Field(
        0.15, ge=0, le=1,
        description="Largest share of target_points that fill may take from well-known points; it "
        "may have what these leave, too.",
    )  # fmt: skip


class SapStage(Stage):
    """Reduce the dense cloud to what a splat fit can use."""

    name = "sap"
    version = 4
    summary = "voxel downsampling, then scale-adaptive pruning of outliers"
    Config = SapConfig
    requires = ("points",)
    provides = ("points",)
    libraries = ("numpy", "scipy")

    def run(self, context: StageContext) -> None:
        import numpy as np

        from pipeline.artifacts.points import Points
        from stages.sap.budget import reduce_cloud
        from stages.sap.downsample import Cloud
        from stages.sap.prune import survivors
        from stages.sap.spacing import point_scales

        config: SapConfig = context.config
        points: Points = context.load("points")
        cloud = Cloud(points.positions, points.colors, points.normals, points.confidence)
        finite = np.asarray(np.isfinite(cloud.positions).all(axis=1))
        if not finite.any():
            raise ReconstructionError(
                "The point cloud is empty: no part of the scene was seen well enough by two "
                "photographs. Take photographs that overlap more (10 to 20 degrees apart), or look "
                "at the warnings of the stages init and align."
            )
        cloud = cloud[finite]
        before = len(cloud)

        def prune(current: Cloud) -> Cloud:
            scales = point_scales(current.positions, context.threads)
            keep = survivors(
                scales, config.mode, config.quantile, config.large_count, config.large_factor
            )
            return current[keep]

        context.progress("points", 0, 2, points=before)
        if config.order == "prune_first":
            cloud = prune(cloud)
        reduction = reduce_cloud(
            cloud, config.voxel_size, config.target_points,
            config.fill_confidence, config.fill_share, context.threads,
        )  # fmt: skip
        cloud = reduction.cloud
        downsampled = len(cloud)
        context.progress("points", 1, 2, points=downsampled)
        if config.order == "downsample_first":
            cloud = prune(cloud)
        if len(cloud) == 0:
            raise ReconstructionError(
                f"Pruning with mode '{config.mode}' left none of {before:,} points. Set "
                "sap.mode=prune or sap.mode=off, or a lower sap.quantile (from sap.large_count "
                "points on: sap.large_factor)."
            )
        scales = point_scales(cloud.positions, context.threads)
        context.save(Points(cloud.positions, cloud.colors, cloud.normals, cloud.confidence, scales))
        context.progress("points", 2, 2, points=len(cloud))
        fill = int((cloud.confidence <= config.fill_confidence).sum())
        context.summarize(
            points_before=before,
            points_after_downsampling=downsampled,
            points_after_pruning=len(cloud),
            fill_percent=round(100 * fill / len(cloud), 1),
        )
