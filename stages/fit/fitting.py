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
from stages.fit.backend import use_backend
from stages.fit.floaters import before_lens, contribution
from stages.fit.initial import Frame
from stages.fit.lighting import choose_light, harmonics_for_viewers
from stages.fit.objectives import logit
from stages.fit.scene import prepare
from stages.fit.settings import FitSettings
from stages.fit.trainer import Trainer
from stages.splatting.rasterizer import rasterize, unpack, use_threads

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class FitResult:
    """Attributes:
    gaussians: in world coordinates.
    cameras: with refined poses, as given.
    psnr, ssim: [V] of the training views at full size.
    pruned: Gaussians removed at the end.
    flow_pairs: pairs that the flow loss used.
    light: ``"camera"`` or ``"none"``, what was used.
    surface_held: Gaussians were held to the surface of the points.
    surface_bent: by how much 95 % of the surface has moved at most, as a share of the scene's
        depth; 0 where it was left as it is.
    backend: ``"cpu"`` or ``"gsplat"``, what was used.
    backend_note: why a card was not used, if there is one.
    light_figures: PSNR of the held-out photograph in the trials, where there were any.
    """

    gaussians: Gaussians
    cameras: tuple[Camera, ...]
    psnr: Array
    ssim: Array
    pruned: int
    flow_pairs: int
    light: str
    light_figures: dict[str, float]
    surface_held: bool
    surface_bent: float
    backend: str
    backend_note: str | None


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
    diary: Path | None = None,
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
        diary: folder for the loss curve and previews, or None.

    Raises:
        ReconstructionError: the fit diverged, or nothing is left of it.
        RequestError: `backend` can't be had.
    """
    use_threads(threads)
    scene = prepare(views, cameras, points, flow, settings)
    light = settings.light
    figures: dict[str, float] = {}
    if light == "auto":
        light, figures = choose_light(scene, settings)
    lit = light == "camera"
    trainer = scene.trainer(settings, lit)
    note = use_backend(trainer)
    trainer.run(checkpoint, report, diary)
    keep = worth_keeping(trainer, scene.cloud.positions)
    if not keep.any():
        raise ReconstructionError(
            "Nothing is left of the fit: no Gaussian colours any photograph. The points and the "
            "cameras that it started from don't agree; look at what align and sap made of them."
        )
    before = len(trainer.packed)
    trainer.replace(
        np.ascontiguousarray(trainer.packed[keep]), np.flatnonzero(keep),
        np.zeros(int(keep.sum()), bool),
    )  # fmt: skip
    psnr, ssim = trainer.training_scores()
    gaussians = unpack(trainer.packed)
    if trainer.light is not None:
        gaussians = replace(
            unpack(harmonics_for_viewers(trainer, scene.cameras).packed),
            light=trainer.light.light(scene.frame.scale),
        )
    colour = trainer.background.values
    if colour.any():
        red, green, blue = (float(value) for value in colour)
        gaussians = replace(gaussians, background=(red, green, blue))
    poses = trainer.poses.poses
    factor = float(np.exp(trainer.focal.log_factor))
    refined = [
        replace(
            camera, fx=camera.fx * factor, fy=camera.fy * factor,
            cam_from_world=scene.frame.cam_from_world(pose) if moved else camera.cam_from_world,
        )
        for camera, pose, moved in zip(cameras, poses, trainer.poses.steps > 0, strict=True)
    ]  # fmt: skip
    return FitResult(
        to_world(gaussians, scene.frame), tuple(refined), psnr, ssim,
        before - len(trainer.packed), len(scene.flows), light, figures,
        trainer.held_surface is not None,
        trainer.warp.reach() if trainer.warp is not None else 0.0,
        "cpu" if trainer.rasterize is rasterize else "gsplat", note,
    )  # fmt: skip


def to_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    means = gaussians.means.astype(np.float64) * frame.scale + frame.centre
    return replace(
        gaussians,
        means=means.astype(np.float32),
        log_scales=gaussians.log_scales + np.float32(np.log(frame.scale)),
    )


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
