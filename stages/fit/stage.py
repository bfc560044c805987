"""`fit`: optimise Gaussians and camera poses against the photographs."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.flow import Flow
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageConfig, StageContext, runtime

Auto = Literal["auto"]
AUTO: Any = "auto"


def number(default: Any, description: str, **bounds: Any) -> Any:
    return Field(default, description=description, **bounds)


class FitConfig(StageConfig):
    """``auto`` follows the number of placed views; the summary tells what it came to."""

    iterations: Auto | int = number(
        AUTO, "optimiser steps, one view each (auto: 400 at 3 views, 1000 from 6)"
    )
    initial_points: Auto | int = number(
        AUTO, "thin the input points to about this many (auto: 15000, 30000 from 6 views)"
    )
    initial_opacity: float = number(
        0.9, "opacity that Gaussians start with (3DGS: 0.1)", gt=0, lt=1
    )
    initial_scale: float = number(
        0.6,
        "standard deviation they start with, as a multiple of the spacing of the points (3DGS: 1)",
        gt=0,
        le=10,
    )
    initial_scale_max_px: float = number(
        6.0, "and its largest value, in pixels of the nearest view", gt=0
    )
    sh_degree: int = number(1, "degree of the spherical harmonics", ge=0, le=3)
    sh_degree_interval: int = number(
        0, "iterations until the next degree is used; 0: all from the start (3DGS: 1000)", ge=0
    )
    headlight: float = number(
        0.6,
        "share of the light that comes from the camera, to start degree 1 from normals",
        ge=0,
        lt=1,
    )
    lambda_dssim: float = number(
        0.2, "weight of 1 - SSIM against L1 in the colour loss", ge=0, le=1
    )
    lambda_flow: float = number(
        0.01, "weight of the flow loss, per pixel of flow error; 0: none", ge=0
    )
    lambda_depth: Auto | float = number(
        AUTO,
        "weight of the depth prior from the input points, in units of the scene's depth; 0: none",
    )
    coarse_fraction: float = number(0.6, "share of the iterations at reduced size", ge=0, le=1)
    coarse_factor: int = number(2, "by which factor images are reduced then", ge=1, le=8)
    position_lr_init: float = number(
        1.6e-4, "learning rate of positions at the start, relative to the scene's extent", gt=0
    )
    position_lr_final: float = number(1.6e-6, "learning rate of positions at the end", gt=0)
    feature_lr: Auto | float = number(
        AUTO,
        "learning rate of the constant colour (3DGS: 0.0025; auto: 2 or 6 times that)",
    )
    feature_rest_lr: Auto | float = number(
        AUTO, "learning rate of the other harmonics (3DGS: 0.000125)"
    )
    opacity_lr: float = number(0.05, "learning rate of opacities", ge=0)
    scaling_lr: Auto | float = number(AUTO, "learning rate of log scales (3DGS: 0.005)")
    rotation_lr: Auto | float = number(AUTO, "learning rate of rotations (3DGS: 0.001)")
    optimize_poses: bool = number(True, "refine the camera poses as well")
    pose_lr_init: Auto | float = number(
        AUTO,
        "learning rate of pose increments at the start, radians and units of the scene's depth",
    )
    pose_lr_final: Auto | float = number(AUTO, "learning rate of pose increments at the end")
    pose_from_iter: int = number(0, "first iteration that refines poses", ge=0)
    exposure: bool = number(
        False, "fit a gain and a bias per view and channel, for cameras that change exposure"
    )
    exposure_lr: float = number(1e-3, "learning rate of exposure", gt=0)
    densify: Auto | bool = number(AUTO, "clone and split Gaussians (auto: from 6 views)")
    absgrad: Literal["split", "both", "off"] = number(
        "split",
        "absolute gradients decide on: splits (AbsGS), splits and clones (gsplat), neither (3DGS)",
    )
    densify_from_iter: int = number(300, "first iteration of densification", ge=0)
    densify_until_iter: Auto | int = number(
        AUTO, "last iteration of densification (auto: 100 before the end)"
    )
    densification_interval: int = number(100, "iterations between densifications", ge=1)
    densify_grad_threshold: float = number(
        2e-4, "signed screen gradient above which Gaussians are densified", gt=0
    )
    densify_abs_grad_threshold: float = number(
        4e-4, "absolute screen gradient above which Gaussians are densified", gt=0
    )
    percent_dense: float = number(
        1e-3, "Gaussians up to this share of the extent are cloned, larger ones split", gt=0
    )
    max_gaussians: Auto | int = number(
        AUTO, "densification stops here; the largest gradients come first (auto: 60000)"
    )
    opacity_reset_interval: int = number(3000, "iterations between opacity resets; 0: never", ge=0)
    prune_opacity: float = number(0.005, "Gaussians below this opacity are removed", gt=0, lt=0.5)
    final_prune_contribution: float = number(
        0.05,
        "at the end, remove Gaussians that colour less than this many pixels in every view",
        ge=0,
    )
    final_prune_near: float = number(
        0.5,
        "finally remove Gaussians nearer to a view than this share of its nearest depth",
        ge=0,
        lt=1,
    )
    final_prune_masked: float = number(
        0.2,
        "finally remove Gaussians with less than this share of their area inside the masks",
        ge=0,
        le=1,
    )
    near: float = number(0.05, "near plane, as a share of the scene's median depth", gt=0)
    background: tuple[float, float, float] = number(
        (0.0, 0.0, 0.0), "colour behind everything, sRGB 0..1"
    )
    checkpoint_every: int = runtime(100, ge=1, description="iterations between checkpoints")

    @model_validator(mode="after")
    def _check(self) -> FitConfig:
        limits = {
            "iterations": 1, "initial_points": 4, "lambda_depth": 0, "feature_lr": 0,
            "feature_rest_lr": 0, "scaling_lr": 0, "rotation_lr": 0, "pose_lr_init": 0,
            "pose_lr_final": 0, "densify_until_iter": 0, "max_gaussians": 1,
        }  # fmt: skip
        for name, least in limits.items():
            value = getattr(self, name)
            if value != "auto" and value < least:
                raise ValueError(f"{name} must be 'auto' or at least {least}, not {value}")
        return self


class FitStage(Stage):
    """views + cameras + points (+ flow) -> gaussians + refined cameras."""

    name: ClassVar[str] = "fit"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "optimise Gaussians and camera poses against the photographs"
    Config: ClassVar[type[StageConfig]] = FitConfig
    requires: ClassVar[tuple[str, ...]] = ("views", "cameras", "points")
    optional: ClassVar[tuple[str, ...]] = ("flow",)
    provides: ClassVar[tuple[str, ...]] = ("gaussians", "cameras")
    libraries: ClassVar[tuple[str, ...]] = (
        "numba",
        "numpy",
        "opencv-contrib-python-headless",
        "scipy",
    )

    def run(self, context: StageContext) -> None:
        from stages.fit.fitting import fit
        from stages.fit.settings import resolve

        views: Views = context.load("views")
        cameras: Cameras = context.load("cameras")
        points: Points = context.load("points")
        flow: Flow | None = context.load("flow") if context.has("flow") else None
        by_name = cameras.by_name()
        placed = [view for view in views.views if view.name in by_name]
        if len(placed) < 2:
            raise ReconstructionError(
                f"Only {len(placed)} of {len(views)} photographs could be placed in space; a fit "
                "needs two. Take photographs that overlap more, or more of them."
            )
        if len(points) < 100:
            raise ReconstructionError(
                f"There are only {len(points)} points to start from; a fit needs 100. The "
                "photographs hardly match each other: take them closer together and in focus, or "
                "loosen what the earlier stages prune (sap, align)."
            )
        settings = resolve(context.config.model_dump(), len(placed), context.seed)

        def report(iteration: int, loss: float, psnr: float, gaussians: int) -> None:
            figures = {"loss": round(loss, 5), "psnr": round(psnr, 2), "gaussians": gaussians}
            context.progress("fit", iteration, settings.iterations, **figures)

        context.progress("preparing (a first run compiles its kernels)", 0, 1)
        result = fit(
            placed, [by_name[view.name] for view in placed], points, flow, settings,
            threads=context.threads, checkpoint=context.scratch / "fit.npz", report=report,
        )  # fmt: skip
        refined = {camera.name: camera for camera in result.cameras}
        context.save(result.gaussians)
        context.save(
            Cameras(
                tuple(refined.get(camera.name, camera) for camera in cameras.cameras),
                cameras.input_from_world,
                cameras.units,
            )
        )
        context.summarize(
            gaussians=len(result.gaussians),
            iterations=settings.iterations,
            train_psnr=round(float(result.psnr.mean()), 3),
            train_ssim=round(float(result.ssim.mean()), 4),
            pruned_at_end=result.pruned,
            densify=str(settings.densify),
            feature_lr=settings.feature_lr,
            scaling_lr=settings.scaling_lr,
            lambda_depth=settings.lambda_depth,
            flow_pairs=result.flow_pairs,
        )
