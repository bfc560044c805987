"""What a user can turn in the fit, under the names that the field knows it by."""

from __future__ import annotations

from math import sqrt
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline.stage import runtime
from stages.fit.parts.base import Part
from stages.fit.parts.camera import Background, Exposure, Focal, Poses
from stages.fit.parts.colours import Colours
from stages.fit.parts.density import SETTLE, Density, Floaters, Isotropic, Mcmc
from stages.fit.parts.detail import Detail
from stages.fit.parts.extension import MORE, Extension
from stages.fit.parts.harmonics import Harmonics, Photometry
from stages.fit.parts.light import Light
from stages.fit.parts.objectives import Depth, Flow, Silhouette, Variation
from stages.fit.parts.progressive import Progressive
from stages.fit.parts.start import Coarse, Filling, Saturation, Shading
from stages.fit.parts.surface import Lining, Surface, Warp
from stages.fit.settings import (
    AUTO,
    PIXELS,
    AutoFloat,
    AutoInt,
    PartSettings,
    Positive,
    Share,
    Weight,
    Whole,
    automatic,
    by_rule,
)

#: the parts of the fit, in the order in which gradients pass them: from the camera to the scene
PARTS: tuple[type[Part], ...] = (
    Progressive, Filling, Shading, Saturation, Coarse, Extension, Harmonics, Photometry, Detail,
    Exposure, Background, Depth, Flow, Silhouette, Light, Isotropic, Variation, Warp, Mcmc, Surface,
    Lining, Poses, Focal, Density, Floaters, Colours,
)  # fmt: skip
PartName = Literal[
    "background", "coarse", "colours", "density", "depth", "detail", "exposure", "extension",
    "filling", "floaters", "flow", "focal", "harmonics", "isotropic", "light", "lining", "mcmc",
    "photometry", "poses", "progressive", "saturation", "shading", "silhouette", "surface",
    "variation", "warp",
]  # fmt: skip


class Basics(PartSettings):
    """Settings of what every fit has."""

    backend: Literal["auto", "cpu", "gsplat"] = "auto"
    """what draws the Gaussians in every step: our kernels on the processor, which give the same
    bytes every time, or gsplat on an NVIDIA card (auto: a card, if there is one that gives the same
    images and gradients in a first trial, for a fit long enough to make up for its start)"""
    iterations: AutoInt = automatic({3: 400, 6: 500, 12: 600, 24: 700}, held=200, ge=1)
    """optimiser steps, one view each"""
    # on a held surface geometry can't overfit, and more points carry more detail
    # larger views of what isn't held don't need more: with twice as many at 1024 px, unseen views
    # lose .2 to .5 dB
    initial_points: AutoInt = automatic({3: 15000, 6: 30000}, held=30000, grows=True, ge=4)
    """thin the input points to about this many"""
    initial_opacity: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """opacity that Gaussians start with (3DGS: 0.1)"""
    initial_scale: Annotated[float, Field(gt=0, le=10)] = 0.6
    """standard deviation they start with, as a multiple of the spacing of the points (3DGS: 1)"""
    initial_scale_max_px: Positive = 6.0
    """and its largest value, in pixels of the nearest view"""
    sh_degree: AutoInt = automatic({6: 1, 9: 2}, held=2, le=3)
    """degree of the spherical harmonics"""
    sh_degree_interval: Whole = 0
    """iterations until the next degree is used, without a shading to start with; 0: all from the
    start (3DGS: 1000)"""
    lambda_dssim: Share = 0.2
    """weight of 1 - SSIM against L1 in the colour loss"""
    # between many views positions are held by all: with twice the rates that few views bear,
    # 600 steps at 12 views come to more than 700 came to
    position_lr_init: AutoFloat = automatic({3: 3.2e-4, 6: 6e-4}, held=3.2e-4, gt=0, ge=None)
    """learning rate of positions at the start, relative to the scene's extent (3DGS: 1.6e-4)"""
    position_lr_final: AutoFloat = automatic({3: 1.6e-5, 6: 6e-5}, held=1.6e-5, gt=0, ge=None)
    """learning rate of positions at the end (3DGS: 1.6e-6)"""
    feature_lr: AutoFloat = automatic({3: 5e-3, 6: 0.015}, held=0.04)
    """learning rate of the constant colour (3DGS: 0.0025)"""
    feature_rest_lr: AutoFloat = automatic({3: 2.5e-4, 6: 7.5e-4, 9: 2e-3}, held=4e-3)
    """learning rate of the other harmonics (3DGS: 0.000125)"""
    opacity_lr: Weight = 0.05
    """learning rate of opacities"""
    scaling_lr: AutoFloat = automatic({3: 0.01, 6: 0.03}, held=0.02)
    """learning rate of log scales (3DGS: 0.005)"""
    rotation_lr: AutoFloat = automatic({3: 2e-3, 6: 6e-3}, held=4e-3)
    """learning rate of rotations (3DGS: 0.001)"""
    near: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """near plane, as a share of the scene's median depth"""
    divergence_factor: Annotated[float, Field(gt=1)] = 5.0
    """stop where the loss (running mean) exceeds its best by this factor"""
    preview_every: Whole = 250
    """iterations between pictures of one view, which go with the loss curve; 0: neither"""


class FitConfig(
    Colours.Settings, Floaters.Settings, Background.Settings, Exposure.Settings, Mcmc.Settings,
    Density.Settings, Detail.Settings, Photometry.Settings, Harmonics.Settings, Warp.Settings,
    Surface.Settings, Lining.Settings, Isotropic.Settings, Focal.Settings, Progressive.Settings,
    Poses.Settings, Extension.Settings, Coarse.Settings, Variation.Settings, Depth.Settings,
    Flow.Settings, Silhouette.Settings, Light.Settings, Saturation.Settings, Shading.Settings,
    Filling.Settings, Basics,
):  # fmt: skip
    """``auto`` follows the number of placed views; the summary tells what it came to.

    Few views overfit: few Gaussians, few iterations, no densification. From six views on a fit of
    1,000 iterations is short of steps: higher rates and densification. On a held surface only
    colours can overfit: many Gaussians, and colours that follow the photographs (all measured, at
    3, 6, 9 and 12 views).
    """

    parts: Literal["auto"] | tuple[PartName, ...] = runtime(
        AUTO,
        description="what a method is made of beside Gaussians that follow the photographs: sets "
        "the settings of these parts, and of those left out, where they are not said (auto: our "
        "own method, as the settings' defaults have it)",
    )
    checkpoint_every: int = runtime(100, ge=1, description="iterations between checkpoints")

    @model_validator(mode="before")
    @classmethod
    def _made_of(cls, values: Any) -> Any:
        """What the parts of a method mean for settings that it does not say."""
        named = values.get("parts", AUTO) if isinstance(values, dict) else AUTO
        if not isinstance(named, (list, tuple)):
            return values
        implied: dict[str, Any] = {}
        for part in PARTS:
            implied |= part.absent if part.name not in named else {}
        for part in PARTS:
            implied |= part.present if part.name in named else {}
        return implied | values

    @model_validator(mode="after")
    def _check(self) -> FitConfig:
        plain = self.light == "none" and self.hold_surface is False and self.lambda_flow == 0
        if self.progressive and not (plain and self.strategy == "default"):
            raise ValueError(
                "progressive works with light none, hold_surface false, lambda_flow 0 and "
                "strategy default only"
            )
        if self.isotropic and (self.hold_surface is not False or self.detail):
            raise ValueError(
                "isotropic works with hold_surface false and detail false only: held Gaussians are "
                "flat, and detail splits them along some of their axes"
            )
        if self.extension_psnr[0] >= self.extension_psnr[1]:
            raise ValueError("the second PSNR of extension_psnr must be higher than the first")
        return self


class FitSettings(FitConfig):
    """A config in which next to nothing is automatic any more, and the seed.

    `light` (a trial decides), `warp_slope` (the light does) and `background` (the masks do) may be.
    """

    seed: int = 0

    def but(self, **changes: Any) -> FitSettings:
        """The same but for some."""
        return self.model_copy(update=changes)


def resolve(
    config: FitConfig, views: int, seed: int, held: bool | None = None, pixels: int = PIXELS
) -> FitSettings:
    """Replace every ``"auto"`` by what it stands for.

    Args:
        config: as the user has it.
        views: how many are placed.
        seed: of the run.
        held: what ``hold_surface: auto`` comes to; None: no.
        pixels: of a view.
    """
    values = dict(config)
    free = values["iterations"] == AUTO
    if values["hold_surface"] == AUTO:
        values["hold_surface"] = bool(held)
    for name, field in FitConfig.model_fields.items():
        rule: Any = field.json_schema_extra
        if values[name] == AUTO and isinstance(rule, dict) and "views" in rule:
            flat = values["hold_surface"] and rule["held"] is not None
            value = rule["held"] if flat else by_rule(rule["views"], views)
            grows = flat and rule["grows"]
            values[name] = round(value * sqrt(pixels / PIXELS)) if grows else value
    if values["extension"] == AUTO:
        values["extension"] = MORE if free and not values["hold_surface"] else 0.0
    if values["densify_until_iter"] == AUTO:
        values["densify_until_iter"] = max(0, values["iterations"] - SETTLE)
    return FitSettings.model_construct(**values, seed=seed)
