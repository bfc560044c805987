"""What a user can turn in the fit, under the names that the field knows it by."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from pipeline.stage import StageConfig, runtime

Auto = Literal["auto"]
AUTO: Any = "auto"


def number(default: Any, description: str, **bounds: Any) -> Any:
    return Field(default, description=description, **bounds)


class FitConfig(StageConfig):
    """``auto`` follows the number of placed views; the summary tells what it came to."""

    backend: Literal["auto", "cpu", "gsplat"] = Field(
        "auto",
        description="what draws the Gaussians in every step: our kernels on the processor, which "
        "give the same bytes every time, or gsplat on an NVIDIA card (auto: a card, if there is "
        "one and it gives the same images and gradients in a first trial)",
    )
    iterations: Auto | int = number(
        AUTO,
        "optimiser steps, one view each (auto: 400 at 3 views, 1000 from 6; 500 on a held surface)",
    )
    initial_points: Auto | int = number(
        AUTO,
        "thin the input points to about this many (auto: 15000, 30000 from 6 views; 60000 on a "
        "held surface, where geometry can't overfit and more points carry more detail)",
    )
    trusted_confidence: Auto | float = number(
        AUTO,
        "input points of less (raw) confidence were filled in: they are no depth prior, and are "
        "left out where they stand before others (auto: 1.5; all are trusted on a held surface)",
    )
    fill_tolerance: float = number(
        0.03,
        "how far behind measured points a filled one may be, as a share of the depth, to be taken "
        "for the same surface (and left out)",
        ge=0,
        le=1,
    )
    fill_share: Auto | float = number(
        AUTO,
        "largest share of the Gaussians that starts from points filled in (auto: 0.03; none from 6 "
        "views: between so many, what was not measured grows better from what was)",
    )
    normal_neighbours: int = number(
        12, "average normals over so many points; 0: as they are", ge=0, le=200
    )
    saturation: float = number(
        0.98,
        "photographs are white from here on: a rendering may be brighter there without penalty",
        gt=0,
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
    sh_degree: Auto | int = number(
        AUTO, "degree of the spherical harmonics (auto: 1; 2 from 9 views and on a held surface)"
    )
    sh_degree_interval: int = number(
        0, "iterations until the next degree is used; 0: all from the start (3DGS: 1000)", ge=0
    )
    headlight: float = number(
        0.6,
        "share of the light that comes from the camera, to start degree 1 from normals",
        ge=0,
        lt=1,
    )
    light: Literal["auto", "camera", "none"] = number(
        "auto",
        "a light beside the lens: albedo, normals, falloff and highlights in place of spherical "
        "harmonics (auto: where a short trial predicts a held-out photograph better with it; on a "
        "held surface where it explains how colours change between photographs)",
    )
    light_diffuse: float = number(
        0.9,
        "share k of light that comes from the lens: 1 - k + k n.v, to start with",
        gt=0,
        lt=0.98,
    )
    light_falloff: float = number(2.0, "exponent of the light's falloff, to start with", ge=0, le=4)
    light_widths: tuple[float, float] = number(
        (200.0, 25.0), "exponents m of the narrow and broad highlight lobe, to start with"
    )
    light_strengths: Auto | tuple[float, float] = number(
        AUTO,
        "strengths of the two lobes in linear light, to start with (auto: 0.5 and 0.04; 0.3 and "
        "0.04 on a held surface)",
    )
    light_gamma: float = number(2.2, "exponent of the photographs' encoding", ge=1, le=4)
    light_albedo_lr: Auto | float = number(
        AUTO,
        "learning rate of albedos (auto: 0.0014; 0.0042 from 6 views; 0.005 on a held surface, "
        "where neighbours pass on to one another what they are)",
    )
    light_normal_lr: Auto | float = number(
        AUTO, "learning rate of the normals that are lit (auto: 0.005; 0.002 on a held surface)"
    )
    light_lr: float = number(1e-2, "learning rate of logit k and of the lobes' log widths", ge=0)
    light_falloff_lr: float = number(5e-3, "learning rate of the falloff's exponent", ge=0)
    light_strength_lr: Auto | float = number(
        AUTO,
        "learning rate of the lobes' log strengths (auto: 0.02; 0 on a held surface: views too far "
        "apart to share a highlight bend normals until any strength fits)",
    )
    light_lr_decay: float = number(
        0.1, "what the light's, albedos' and normals' rates have fallen to at the end", gt=0, le=1
    )
    light_sh_iterations: int = number(
        120,
        "steps at reduced size that fit the spherical harmonics of the .ply to the lit scene",
        ge=0,
    )
    light_sh_rest_lr: float = number(
        5e-3, "learning rate of the harmonics above the constant in those steps", ge=0
    )
    light_trial_iterations: int = number(100, "steps of each trial of light: auto", ge=1)
    light_trial_points: int = number(6000, "Gaussians of each trial of light: auto", ge=100)
    light_trial_factor: int = number(4, "by which factor its images are reduced", ge=1, le=16)
    light_margin: float = number(
        0.1, "dB by which the trial with a light has to be better on the held-out photograph", ge=0
    )
    light_evidence: float = number(
        0.7,
        "on a held surface there is a light if its shading lowers the error of predicting the "
        "photographs from one another to this share",
        ge=0,
        le=1,
    )
    lambda_dssim: float = number(
        0.2, "weight of 1 - SSIM against L1 in the colour loss", ge=0, le=1
    )
    lambda_flow: float = number(
        0.01, "weight of the flow loss, per pixel of flow error; 0: none", ge=0
    )
    lambda_depth: Auto | float = number(
        AUTO,
        "weight of the depth prior from the input points, in units of the scene's depth; 0: none "
        "(auto: 0.5, 0.3 from 6 views, none on a held surface)",
    )
    lambda_tv: Auto | float = number(
        AUTO,
        "weight of the mean difference between the colours of neighbouring Gaussians: albedos with "
        "a light beside the lens, else harmonics (auto: 0.2 on a held surface, else none)",
    )
    tv_neighbours: int = number(24, "Gaussians that each is compared with", ge=1, le=64)
    tv_tolerance: float = number(
        0.02, "differences of colour below this count by their squares only", gt=0
    )
    coarse_fraction: float = number(0.6, "share of the iterations at reduced size", ge=0, le=1)
    coarse_factor: int = number(2, "by which factor images are reduced then", ge=1, le=8)
    position_lr_init: float = number(
        3.2e-4,
        "learning rate of positions at the start, relative to the scene's extent (3DGS: 1.6e-4)",
        gt=0,
    )
    position_lr_final: float = number(
        1.6e-5, "learning rate of positions at the end (3DGS: 1.6e-6)", gt=0
    )
    feature_lr: Auto | float = number(
        AUTO,
        "learning rate of the constant colour (3DGS: 0.0025; auto: twice that; 6 times from 6 "
        "views and on a held surface)",
    )
    feature_rest_lr: Auto | float = number(
        AUTO,
        "learning rate of the other harmonics (3DGS: 0.000125; auto: a twentieth of feature_lr; "
        "0.002 from 9 views and on a held surface)",
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
    progressive: bool = number(
        False,
        "bring in the views one after another in viewing order, each placed by the Gaussians of "
        "those before it (CF-3DGS); of the poses found before, only the first one's is used",
    )
    progressive_iterations: int = number(
        100, "progressive: iterations per view until the next one is placed", ge=1
    )
    progressive_pose_iterations: int = number(
        300, "progressive: steps that place a view, with the Gaussians frozen", ge=1
    )
    progressive_pose_lr_init: float = number(
        3e-3, "progressive: learning rate of the pose at the first of these steps", gt=0
    )
    progressive_pose_lr_final: float = number(3e-5, "progressive: and at the last one", gt=0)
    optimize_focal: bool = number(
        False, "refine the focal length as well, by one factor that all views share"
    )
    focal_lr: float = number(1e-4, "learning rate of that factor's logarithm", gt=0)
    exposure: bool = number(
        False, "fit a gain and a bias per view and channel, for cameras that change exposure"
    )
    exposure_lr: float = number(1e-3, "learning rate of exposure", gt=0)
    isotropic: bool = number(False, "keep the three scales of each Gaussian equal")
    hold_surface: Auto | bool = number(
        AUTO,
        "keep Gaussians flat and on the surface of the input points, in proportion to confidence "
        "(auto: up to 3 views that are far apart)",
    )
    hold_min_angle: float = number(
        22.0, "hold_surface auto: neighbouring views further apart than this, degrees", ge=0, le=180
    )
    hold_strength: float = number(
        0.15, "share of the way back that a sure Gaussian goes after each step", ge=0, le=1
    )
    hold_flatness: float = number(
        0.6, "thickness of held Gaussians, relative to their width", gt=0, le=1
    )
    hold_growth: float = number(
        2.0, "by which factor Gaussians of a held scene may get wider than they start", ge=1
    )
    hold_colors_until: float = number(
        0.0, "up to this share of the iterations, held Gaussians change colour only", ge=0, le=1
    )
    warp_levels: int = number(
        4,
        "bend the surface of the points as a whole by splines of so many widths, each twice the "
        "one before; 0: Gaussians only move on their own",
        ge=0,
        le=8,
    )
    warp_spacing: float = number(
        0.01, "spacing of the finest of these splines, as a share of the scene's depth", gt=0
    )
    warp_spacing_px: float = number(
        5.0, "and no less than so many pixels: what is finer no photograph can tell", gt=0
    )
    warp_slope: Auto | float = number(
        AUTO,
        "no width of splines gets steeper than about this (auto: 2 with a light beside the lens; "
        "0.3 without, where highlights that move would tear the surface)",
    )
    warp_lr_init: Auto | float = number(
        AUTO,
        "learning rate of the splines at the start, as a share of the scene's depth (auto: 1e-4; "
        "3e-4 on a held surface, where nothing else moves it)",
    )
    warp_lr_final: Auto | float = number(
        AUTO, "learning rate of the splines at the end (auto: 1e-5; 1e-4 on a held surface)"
    )
    densify: Auto | bool = number(AUTO, "clone and split Gaussians (auto: from 6 views)")
    strategy: Literal["default", "mcmc"] = number(
        "default", "densify by cloning and splitting (3DGS), or by sampling (3DGS-MCMC)"
    )
    noise_lr: float = number(5e5, "mcmc: noise, relative to the learning rate of positions", ge=0)
    opacity_reg: float = number(0.0, "weight of the mean opacity in the loss (mcmc: 0.01)", ge=0)
    scale_reg: float = number(0.0, "weight of the mean scale in the loss (mcmc: 0.01)", ge=0)
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
    final_prune_masked: Auto | float = number(
        AUTO,
        "finally remove Gaussians with less than this share of their area inside the masks: they "
        "have grown out of them (auto: 0.2; 0 on a held surface, which has a rim and no needles)",
    )
    near: float = number(0.05, "near plane, as a share of the scene's median depth", gt=0)
    background: Auto | tuple[float, float, float] = number(
        AUTO,
        "colour behind everything, sRGB 0..1 (auto: found by the fit; black where photographs are "
        "partly masked out)",
    )
    background_lr: float = number(1e-2, "learning rate of that colour", ge=0)
    divergence_factor: float = number(
        5.0, "stop where the loss (running mean) exceeds its best by this factor", gt=1
    )
    preview_every: int = number(
        250, "iterations between pictures of one view, beside the loss curve; 0: none", ge=0
    )
    checkpoint_every: int = runtime(100, ge=1, description="iterations between checkpoints")

    @model_validator(mode="after")
    def _check(self) -> FitConfig:
        limits = {
            "iterations": 1, "initial_points": 4, "lambda_depth": 0, "feature_lr": 0,
            "feature_rest_lr": 0, "light_albedo_lr": 0, "scaling_lr": 0, "rotation_lr": 0,
            "pose_lr_init": 0, "pose_lr_final": 0, "densify_until_iter": 0, "max_gaussians": 1,
            "trusted_confidence": 1, "sh_degree": 0, "final_prune_masked": 0,
            "light_strength_lr": 0, "light_normal_lr": 0, "fill_share": 0,
            "warp_lr_init": 0, "warp_lr_final": 0, "warp_slope": 1e-3, "lambda_tv": 0,
        }  # fmt: skip
        if self.progressive:
            plain = self.light == "none" and self.hold_surface is False and self.lambda_flow == 0
            if not plain or self.strategy != "default":
                raise ValueError(
                    "progressive works with light none, hold_surface false, lambda_flow 0 and "
                    "strategy default only"
                )
        for name, least in limits.items():
            value = getattr(self, name)
            if value != "auto" and value < least:
                raise ValueError(f"{name} must be 'auto' or at least {least}, not {value}")
        for name, most in {"sh_degree": 3, "final_prune_masked": 1, "fill_share": 1}.items():
            value = getattr(self, name)
            if value != "auto" and value > most:
                raise ValueError(f"{name} must be 'auto' or at most {most}, not {value}")
        return self
