"""The stage `init`: photographs in, cameras, a first dense cloud and pointmaps out."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.pointmaps import Pointmaps
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageConfig, StageContext
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


class InitConfig(StageConfig):
    """How cameras and first points are found."""

    method: Literal["auto", "colmap"] = Field("auto", description="how to find the cameras")
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


class InitStage(Stage):
    """Views -> cameras, points, pointmaps."""

    name = "init"
    version = 1
    summary = "find the cameras and a first dense cloud"
    Config = InitConfig
    requires = ("views",)
    provides = ("cameras", "points", "pointmaps")
    libraries = ("pycolmap", "opencv-contrib-python-headless", "numpy", "scipy", "numba")
    methods = {  # noqa: RUF012
        "auto": "the best that is available: colmap",
        "colmap": "yaw-compensated SIFT, COLMAP's mappers, plane-sweep stereo; no network needed",
    }

    def run(self, context: StageContext) -> None:
        """Place the views, densify, and write what came out.

        Raises:
            ReconstructionError: the photographs don't allow it; the message says why.
        """
        from stages.init.classical import reconstruct
        from stages.init.diagnosis import Limits, failure, least_views
        from stages.init.options import ClassicalOptions

        config: InitConfig = context.config
        views: Views = context.load("views")
        focals = [
            config.focal * max(view.width, view.height) if config.focal else view.focal_px
            for view in views.views
        ]
        options = ClassicalOptions(
            **{name: getattr(config, name) for name in ClassicalOptions.__dataclass_fields__}
        )
        names = [view.source_name or view.name for view in views.views]
        limits = Limits(
            min_views=least_views(len(views), config.min_views_fraction),
            max_error=config.max_reprojection_error * _pixel(views),
        )
        attempt = reconstruct(
            [view.gray() for view in views.views],
            [view.valid() for view in views.views],
            focals,
            config.focal is not None,
            views.ordered,
            options,
            seed=context.seed,
            threads=context.threads,
            scratch=context.scratch,
            progress=context.progress,
        )
        diagnosis = failure(attempt, names, limits)
        if diagnosis:
            raise ReconstructionError(diagnosis)
        assert attempt.solution is not None
        unplaced = [name for view, name in enumerate(names) if view not in attempt.solution.poses]
        if unplaced:
            context.warn(
                f"{len(unplaced)} of {len(names)} photographs could not be placed and are left "
                f"out: {', '.join(unplaced)}."
            )
        if not attempt.focal_determined:
            context.warn(
                "The photographs don't determine the focal length; the proportions of the scene "
                "may be off. Keep the EXIF data or pass --set init.focal=..."
            )
        _densify(context, views, attempt)


def _densify(context: StageContext, views: Views, attempt: Any) -> None:
    """Dense stereo from the cameras found, and everything written."""
    from stages.init import cloud
    from stages.init.dense import dense_depths
    from stages.init.geometry import spanning_tree
    from stages.init.normalise import moved_points, moved_pose, world_similarity

    config: InitConfig = context.config
    solution = attempt.solution
    order = sorted(solution.poses)
    similarity = world_similarity([solution.poses[view] for view in order], solution.points)
    points = moved_points(solution.points, *similarity)
    placed: list[View] = [views.views[view] for view in order]
    cameras = [
        Camera(
            name=view.name, width=view.width, height=view.height,
            fx=solution.focals[index], fy=solution.focals[index],
            cx=view.width / 2, cy=view.height / 2,
            cam_from_world=moved_pose(solution.poses[index], *similarity),
        )
        for index, view in zip(order, placed, strict=True)
    ]  # fmt: skip
    images = [view.image for view in placed]
    dense = dense_depths(
        images,
        [view.valid() for view in placed],
        cameras,
        [points[solution.points_of(index)].astype(np.float32) for index in order],
        DenseOptions(**config.dense.model_dump()),
        context.threads,
        lambda done, total: context.progress("dense stereo", done, total),
    )
    clouds = [
        cloud.depth_points(image, found.depth, found.normal, found.confidence, camera)
        for image, found, camera in zip(images, dense, cameras, strict=True)
    ]
    dense_count = sum(len(found) for found in clouds)
    if dense_count < config.min_dense_points:
        context.warn(
            f"Dense stereo found only {dense_count} points; the {len(points)} points of the sparse "
            "reconstruction are added. The surface will have holes."
        )
        clouds.append(cloud.sparse_points(points, images, cameras))
    if config.fill_step:
        for image, found, camera in zip(images, dense, cameras, strict=True):
            rest = np.where(found.depth > 0, np.float32(0), found.filled)
            clouds.append(
                cloud.depth_points(
                    image, rest, found.normal, found.confidence, camera, config.fill_step
                )
            )
    result = cloud.thinned(cloud.joined(clouds), config.max_points, context.seed)

    index_of = {view: number for number, view in enumerate(order)}
    weights = {
        (index_of[i], index_of[j]): edge.evidence
        for (i, j), edge in attempt.evidence.edges.items()
        if (i, j) in solution.edges and i in index_of and j in index_of
    }
    tree = spanning_tree(weights, len(order))
    context.save(Cameras(cameras=tuple(cameras)))
    context.save(result)
    depths = [np.where(found.depth > 0, found.depth, found.filled) for found in dense]
    pairs = [
        cloud.pointmap_pair(
            cameras[i], cameras[j], depths[i], depths[j], dense[i].confidence, dense[j].confidence
        )
        for i, j in cloud.pointmap_edges(weights, tree, len(order))
    ]
    context.save(Pointmaps(pairs))
    context.summarize(
        views_registered=len(order),
        views_total=len(views),
        focal=round(float(np.median([c.fx / max(c.width, c.height) for c in cameras])), 4),
        reprojection_error_px=round(solution.error, 3),
        matches=int(sum(len(edge.inliers) for edge in attempt.evidence.edges.values())),
        sparse_points=len(points),
        dense_points=dense_count,
        points=len(result),
    )


def _pixel(views: Views) -> float:
    """Size of the working images relative to what pixel thresholds are given for."""
    from stages.init.options import REFERENCE_SIDE

    return max(max(view.width, view.height) for view in views.views) / REFERENCE_SIDE
