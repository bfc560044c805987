"""A whole fit: artifacts' arrays in, Gaussians and refined cameras out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.flow import Flow
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from stages.fit.backend import use_backend
from stages.fit.config import FitSettings
from stages.fit.inputs.initial import Frame
from stages.fit.inputs.scene import prepare
from stages.fit.lighting import choose_light, harmonics_for_viewers
from stages.fit.parts.camera import Background
from stages.fit.parts.light import Light
from stages.fit.trainer import Trainer
from stages.splatting.rasterizer import rasterize, unpack, use_threads


@dataclass(frozen=True)
class FitResult:
    """Attributes:
    gaussians: in world coordinates.
    cameras: with refined poses, as given.
    figures: for the summary.
    backend_note: why a card was not used, if there is one.
    """

    gaussians: Gaussians
    cameras: tuple[Camera, ...]
    figures: dict[str, float | int | str]
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
    report: Callable[[int, int, float, float, int], None],
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
        report: called with iteration, of how many, loss, PSNR and number of Gaussians.
        diary: folder for the loss curve and previews, or None.

    Raises:
        ReconstructionError: the fit diverged, or nothing is left of it.
        RequestError: `backend` can't be had.
    """
    use_threads(threads)
    scene = prepare(views, cameras, points, flow, settings)
    light: str = settings.light
    figures: dict[str, float] = {}
    if light == "auto":
        light, figures = choose_light(scene, settings)
    trainer = scene.trainer(settings, light == "camera")
    note = use_backend(trainer)
    trainer.run(checkpoint, report, diary)
    for part in trainer.parts:
        part.end(trainer)
    psnr, ssim = trainer.training_scores()
    gaussians = finished(trainer, scene.cameras, scene.frame)
    factor = float(np.exp(trainer.focal.log_factor))
    refined = [
        replace(
            camera, fx=camera.fx * factor, fy=camera.fy * factor,
            cam_from_world=scene.frame.cam_from_world(pose) if moved else camera.cam_from_world,
        )
        for camera, pose, moved in zip(
            cameras, trainer.poses.poses, trainer.poses.steps > 0, strict=True
        )
    ]  # fmt: skip
    summary: dict[str, float | int | str] = {
        "gaussians": len(gaussians),
        "iterations": trainer.iterations,
        "backend": "cpu" if trainer.rasterize is rasterize else "gsplat",
        "parts": ", ".join(part.name for part in trainer.parts),
        "light": light,
        **figures,
        "train_psnr": round(float(psnr.mean()), 3),
        "train_ssim": round(float(ssim.mean()), 4),
        "feature_lr": settings.feature_lr,
        "scaling_lr": settings.scaling_lr,
    }
    for part in trainer.parts:
        summary |= part.summary()
    return FitResult(gaussians, tuple(refined), summary, note)


def finished(trainer: Trainer, cameras: Sequence[Camera], frame: Frame) -> Gaussians:
    """What a fit has come to, in the world.

    Args:
        cameras: of the scene, in the frame.
        frame: of the fit.
    """
    gaussians = unpack(trainer.packed)
    light, backdrop = trainer.find(Light), trainer.find(Background)
    if light is not None:
        gaussians = replace(
            unpack(harmonics_for_viewers(trainer, cameras)),
            light=light.light(frame.scale),
        )
    if backdrop is not None and backdrop.values.any():
        red, green, blue = (float(value) for value in backdrop.values)
        gaussians = replace(gaussians, background=(red, green, blue))
    means = gaussians.means.astype(np.float64) * frame.scale + frame.centre
    return replace(
        gaussians,
        means=means.astype(np.float32),
        log_scales=gaussians.log_scales + np.float32(np.log(frame.scale)),
    )
