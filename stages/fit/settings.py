"""Every constant of the fit, resolved: what the trainer works with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: From this number of views on, a fit is limited by its capacity; below, by what the views say.
MANY_VIEWS = 6
#: from so many on, they see most points from enough sides for two degrees of harmonics
PLENTY_OF_VIEWS = 9
#: what ``warp_slope: auto`` comes to, with a light beside the lens and without
WARP_SLOPE_LIT, WARP_SLOPE = 2.0, 0.3


@dataclass(frozen=True)
class FitSettings:
    """See `config.FitConfig` for what each field means.

    What depends on the views is not ``"auto"`` any more; `light` (a trial decides), `warp_slope`
    (the light does) and `background` (the masks do) may be.
    """

    backend: str
    iterations: int
    initial_points: int
    trusted_confidence: float
    fill_tolerance: float
    fill_share: float
    normal_neighbours: int
    saturation: float
    initial_opacity: float
    initial_scale: float
    initial_scale_max_px: float
    sh_degree: int
    sh_degree_interval: int
    headlight: float
    light: str
    light_diffuse: float
    light_falloff: float
    light_widths: tuple[float, float]
    light_strengths: tuple[float, float]
    light_gamma: float
    light_albedo_lr: float
    light_normal_lr: float
    light_lr: float
    light_falloff_lr: float
    light_strength_lr: float
    light_lr_decay: float
    light_sh_iterations: int
    light_sh_rest_lr: float
    light_trial_iterations: int
    light_trial_points: int
    light_trial_factor: int
    light_margin: float
    light_evidence: float
    lambda_dssim: float
    lambda_flow: float
    lambda_depth: float
    lambda_tv: float
    tv_neighbours: int
    tv_tolerance: float
    coarse_fraction: float
    coarse_factor: int
    position_lr_init: float
    position_lr_final: float
    feature_lr: float
    feature_rest_lr: float
    opacity_lr: float
    scaling_lr: float
    rotation_lr: float
    optimize_poses: bool
    pose_lr_init: float
    pose_lr_final: float
    pose_from_iter: int
    progressive: bool
    progressive_iterations: int
    progressive_pose_iterations: int
    progressive_pose_lr_init: float
    progressive_pose_lr_final: float
    optimize_focal: bool
    focal_lr: float
    exposure: bool
    exposure_lr: float
    isotropic: bool
    hold_surface: bool
    hold_min_angle: float
    hold_strength: float
    hold_flatness: float
    hold_growth: float
    hold_colors_until: float
    warp_levels: int
    warp_spacing: float
    warp_slope: float | str
    warp_spacing_px: float
    warp_lr_init: float
    warp_lr_final: float
    densify: bool
    strategy: str
    noise_lr: float
    opacity_reg: float
    scale_reg: float
    absgrad: str
    densify_from_iter: int
    densify_until_iter: int
    densification_interval: int
    densify_grad_threshold: float
    densify_abs_grad_threshold: float
    percent_dense: float
    max_gaussians: int
    opacity_reset_interval: int
    prune_opacity: float
    final_prune_contribution: float
    final_prune_near: float
    final_prune_masked: float
    near: float
    background: tuple[float, float, float] | str
    background_lr: float
    seed: int
    divergence_factor: float
    preview_every: int
    checkpoint_every: int

    def steepest(self, lit: bool) -> float:
        """The slope that a warp may have: more where highlights are not taken for shape."""
        if isinstance(self.warp_slope, str):
            return WARP_SLOPE_LIT if lit else WARP_SLOPE
        return self.warp_slope


def automatic(views: int, held: bool = False) -> dict[str, Any]:
    """The values that ``"auto"`` stands for.

    Few views overfit: few Gaussians, few iterations, no densification. From six views on a fit of
    1,000 iterations is short of steps: higher rates and densification. On a held surface only
    colours can overfit: many Gaussians, and colours that follow the photographs (all measured).

    Args:
        views: how many are placed.
        held: Gaussians are held to their surface.
    """
    many, plenty = views >= MANY_VIEWS, views >= PLENTY_OF_VIEWS
    rate = 6.0 if many else 2.0
    iterations = 1000 if many else 400 + 200 * max(0, views - 3)
    chosen = {
        "hold_surface": held,
        "iterations": iterations,
        "initial_points": 30000 if many else 15000,
        "trusted_confidence": 1.5,
        "fill_share": 0.0 if many else 0.03,
        "sh_degree": 2 if plenty else 1,
        "final_prune_masked": 0.2,
        "feature_lr": 2.5e-3 * rate,
        "feature_rest_lr": 2e-3 if plenty else 2.5e-3 / 20 * rate,
        # in colour, not in harmonics: C0 times as much
        "light_albedo_lr": 7e-4 * rate,
        "light_normal_lr": 5e-3,
        "light_strengths": (0.5, 0.04),
        "light_strength_lr": 2e-2,
        "scaling_lr": 5e-3 * rate,
        "rotation_lr": 1e-3 * rate,
        "densify": many,
        "max_gaussians": 60000 if many else 15000,
        "lambda_depth": 0.3 if many else 0.5,
        "lambda_tv": 0.0,
        "warp_lr_init": 1e-4,
        "warp_lr_final": 1e-5,
        "pose_lr_init": 3e-4,
        "pose_lr_final": 3e-6,
    }
    if held:
        chosen |= {
            "iterations": 500,
            "initial_points": 60000,
            "trusted_confidence": 1.0,
            "sh_degree": 2,
            "final_prune_masked": 0.0,
            "feature_lr": 1.5e-2,
            "feature_rest_lr": 2e-3,
            "light_normal_lr": 2e-3,
            "light_strengths": (0.3, 0.04),
            "light_strength_lr": 0.0,
            "lambda_depth": 0.0,
            "lambda_tv": 0.2,
            "light_albedo_lr": 5e-3,
            "warp_lr_init": 3e-4,
            "warp_lr_final": 1e-4,
        }
    return chosen


def resolve(values: dict[str, Any], views: int, seed: int, held: bool | None = None) -> FitSettings:
    """Replace every ``"auto"`` of a config's values by what it stands for.

    Args:
        values: of a `FitConfig`.
        views: how many are placed.
        seed: of the run.
        held: what ``hold_surface: auto`` comes to; None: no.
    """
    resolved = dict(values)
    if resolved["hold_surface"] != "auto":
        held = bool(resolved["hold_surface"])
    for name, value in automatic(views, bool(held)).items():
        if resolved[name] == "auto":
            resolved[name] = value
    if resolved["densify_until_iter"] == "auto":
        # what is split last still needs steps to settle
        resolved["densify_until_iter"] = max(0, resolved["iterations"] - 100)
    return FitSettings(**resolved, seed=seed)
