"""A whole fit: artifacts' arrays in, Gaussians and refined cameras out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.flow import Flow
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from stages.fit.floaters import before_lens, contribution
from stages.fit.initial import Cloud, Frame, choose_frame, initial_gaussians, thin
from stages.fit.settings import FitSettings
from stages.fit.targets import make_pyramids
from stages.fit.trainer import Trainer, logit
from stages.splatting.rasterizer import unpack, use_threads

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

#: scene extent: this times the largest distance of a camera from their middle (3DGS), at least
#: MIN_EXTENT of the scene's depth (cameras that hardly move must not freeze the positions)
EXTENT_MARGIN = 1.1
MIN_EXTENT = 0.25


@dataclass(frozen=True)
class FitResult:
    """Attributes:
    gaussians: in world coordinates.
    cameras: with refined poses, as given.
    psnr, ssim: [V] of the training views at full size.
    pruned: Gaussians removed at the end.
    flow_pairs: pairs that the flow loss used.
    """

    gaussians: Gaussians
    cameras: tuple[Camera, ...]
    psnr: Array
    ssim: Array
    pruned: int
    flow_pairs: int


def fit(
    views: Sequence[View],
    cameras: Sequence[Camera],
    points: Points,
    flow: Flow | None,
    settings: FitSettings,
    *,
    threads: int,
    checkpoint: Path | None,
    report: Callable[[int, float, float, int], None],
) -> FitResult:
    """Fit Gaussians and poses.

    Args:
        views, cameras: the placed views, one camera each, in the same order.
        points: to start from, in the world of the cameras.
        flow: between views, or None.
        settings: all constants.
        threads: never changes the result.
        checkpoint: file to save the state to and to start from, or None.
        report: called with iteration, loss, PSNR and number of Gaussians.

    Raises:
        ReconstructionError: the fit diverged, or nothing is left of it.
    """
    use_threads(threads)
    frame = choose_frame(points.positions.astype(np.float64), cameras)
    local_cameras = [in_frame(camera, frame) for camera in cameras]
    cloud = Cloud(
        frame.points(points.positions), points.colors.astype(np.float64),
        points.normals.astype(np.float64), np.maximum(points.confidence, 1).astype(np.float64),
    )  # fmt: skip
    packed = initial_gaussians(
        thin(cloud, settings.initial_points), local_cameras, opacity=settings.initial_opacity,
        scale=settings.initial_scale, scale_max_px=settings.initial_scale_max_px,
        degree=settings.sh_degree, headlight=settings.headlight,
    )  # fmt: skip
    centres = np.array([camera.centre for camera in local_cameras])
    middle = np.linalg.norm(centres - centres.mean(0), axis=1)
    flows = chosen_flows(views, flow) if settings.lambda_flow > 0 else {}
    factors = [1, settings.coarse_factor] if settings.coarse_fraction > 0 else [1]
    targets = make_pyramids(
        [view.image for view in views], [view.valid() for view in views], local_cameras, factors,
        cloud.positions if settings.lambda_depth > 0 else None, flows,
    )  # fmt: skip
    trainer = Trainer(
        packed, np.array([camera.cam_from_world[:3] for camera in local_cameras]),
        int(middle.argmin()), targets, max(EXTENT_MARGIN * float(middle.max()), MIN_EXTENT),
        settings,
    )  # fmt: skip
    trainer.run(checkpoint, report)
    if not np.isfinite(trainer.packed).all():
        raise ReconstructionError(
            "The fit diverged: some Gaussians are not finite. Lower the learning rates "
            "(fit.feature_lr, fit.scaling_lr, fit.pose_lr_init)."
        )
    keep = worth_keeping(trainer, cloud.positions)
    if not keep.any():
        raise ReconstructionError(
            "Nothing is left of the fit: no Gaussian colours any photograph. The points and the "
            "cameras that it started from don't agree; look at what align and sap made of them."
        )
    before = len(trainer.packed)
    trainer.packed = np.ascontiguousarray(trainer.packed[keep])
    psnr, ssim = trainer.training_scores()
    poses = trainer.poses.poses
    refined = [
        replace(camera, cam_from_world=frame.cam_from_world(pose)) if moved else camera
        for camera, pose, moved in zip(cameras, poses, trainer.poses.steps > 0, strict=True)
    ]
    return FitResult(
        to_world(unpack(trainer.packed), frame), tuple(refined), psnr, ssim,
        before - len(trainer.packed), len(flows),
    )  # fmt: skip


def in_frame(camera: Camera, frame: Frame) -> Camera:
    matrix = np.eye(4)
    matrix[:3] = frame.pose(camera.cam_from_world)
    return replace(camera, cam_from_world=matrix)


def to_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    means = gaussians.means.astype(np.float64) * frame.scale + frame.centre
    return replace(
        gaussians,
        means=means.astype(np.float32),
        log_scales=gaussians.log_scales + np.float32(np.log(frame.scale)),
    )


def chosen_flows(
    views: Sequence[View], flow: Flow | None
) -> dict[int, tuple[int, Floats, npt.NDArray[np.bool_]]]:
    """For each placed view its flow to another placed one: (index of that, flow, mask)."""
    index = {view.name: position for position, view in enumerate(views)}
    chosen: dict[int, tuple[int, Floats, npt.NDArray[np.bool_]]] = {}
    for pair in flow.pairs if flow is not None else ():
        i, j = index.get(pair.name_i), index.get(pair.name_j)
        if i is None or j is None or i in chosen or not pair.mask_forward.any():
            continue
        chosen[i] = (j, pair.forward, pair.mask_forward)
    return chosen


def worth_keeping(trainer: Trainer, positions: Array) -> npt.NDArray[np.bool_]:
    """[N] False for Gaussians that colour nothing, and for those right before a lens.

    What a Gaussian colours outside the masks, no photograph has a say in: one that does mostly
    that is a needle that has grown into the masked part.
    """
    settings = trainer.settings
    most, everywhere, within = np.zeros((3, len(trainer.packed)), np.float32)
    viewpoints, nearest = [], []
    for view, target in enumerate(trainer.targets):
        area, masked_area = contribution(trainer.render(view), target[1].colour.mask)
        most = np.maximum(most, masked_area)
        everywhere += area
        within += masked_area
        viewpoint = trainer.viewpoint(view, target[1])
        local = positions @ viewpoint.pose[:, :3].T.astype(np.float64) + viewpoint.pose[:, 3]
        fx, fy, cx, cy = viewpoint.intrinsics
        z = np.maximum(local[:, 2], 1e-6)
        u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
        inside = (local[:, 2] > 0) & (u >= 0) & (u < target[1].width)
        inside &= (v >= 0) & (v < target[1].height)
        depths = local[inside, 2]
        limit = float(np.quantile(depths, 0.01)) if len(depths) else 0.0
        viewpoints.append(viewpoint)
        nearest.append(settings.final_prune_near * limit)
    keep = (most >= settings.final_prune_contribution) & (
        within >= settings.final_prune_masked * everywhere
    )
    keep &= trainer.packed[:, 10] > logit(settings.prune_opacity)
    return np.asarray(keep & ~before_lens(trainer.packed, viewpoints, nearest))
