"""Gaussians are born and die: densification, and what a finished fit does without."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.errors import ReconstructionError
from stages.fit import numerics
from stages.fit.arrays import AnyArray, Array, Bools, Floats, Indices
from stages.fit.parts.base import Figures, Part, Step, logit
from stages.fit.parts.camera import Background
from stages.fit.settings import (
    PIXELS,
    AutoBool,
    AutoFloat,
    AutoInt,
    Count,
    PartSettings,
    Positive,
    Weight,
    Whole,
    automatic,
)

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Rendering, Viewpoint

#: iterations before the end at which Gaussians are split last: these still need steps to settle
SETTLE = 100


class Density(
    Part, switch="densify", on=True, off=False,
    kept=("statistics.signed", "statistics.absolute", "statistics.seen", "latest"),
):  # fmt: skip
    """Large gradients on the screen decide on clones and splits.

    Attributes:
        statistics: of the gradients since the last densification.
    """

    class Settings(PartSettings):
        densify: AutoBool = automatic({5: False, 6: True})
        """clone and split Gaussians: few views overfit by it"""
        strategy: Literal["default", "mcmc"] = "default"
        """where densify is on: by cloning and splitting (3DGS), or by sampling (3DGS-MCMC)"""
        absgrad: Literal["split", "both", "off"] = "split"
        """absolute gradients decide on: splits (AbsGS), splits and clones (gsplat), neither
        (3DGS)"""
        densify_from_iter: Whole = 150
        """first iteration of densification"""
        densify_until_iter: AutoInt = automatic(f"{SETTLE} before the end")
        """last iteration of densification (before an extension)"""
        densification_interval: Count = 50
        """iterations between densifications"""
        densify_grad_threshold: Positive = 2e-4
        """signed screen gradient above which Gaussians are densified"""
        densify_abs_grad_threshold: Positive = 4e-4
        """absolute screen gradient above which Gaussians are densified"""
        percent_dense: Positive = 1e-3
        """Gaussians up to this share of the extent are cloned, larger ones split"""
        max_gaussians: AutoInt = automatic({3: 15000, 6: 60000}, ge=1)
        """densification stops here; the largest gradients come first"""
        opacity_reset_interval: Whole = 3000
        """iterations between opacity resets, while densification goes on, and at least so many from
        the last one to the end; 0: never"""
        prune_opacity: Annotated[float, Field(gt=0, lt=0.5)] = 0.005
        """Gaussians below this opacity are removed"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.statistics = numerics.density.DensityStatistics.empty(len(fit.packed))

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        wanted = "mcmc" if cls.name == "mcmc" else "default"
        return super().of(fit) if fit.settings.strategy == wanted else None

    def until(self, fit: Trainer) -> int:
        """The last iteration of densification."""
        return self.settings.densify_until_iter + fit.iterations - self.settings.iterations

    def due(self, fit: Trainer) -> bool:
        s, now = self.settings, fit.iteration
        within = s.densify_from_iter <= now <= self.until(fit)
        return within and now % s.densification_interval == 0

    def reset_due(self, fit: Trainer) -> bool:
        """Whether opacities start anew now, with time to come back."""
        now, every = fit.iteration, self.settings.opacity_reset_interval
        last = min(self.until(fit), fit.iterations - every)
        return every > 0 and now % every == 0 and now <= last

    def populate(self, fit: Trainer, step: Step) -> None:
        s = self.settings
        self.statistics.add(
            step.gradients.centres, step.gradients.absolute, step.rendering.visible,
            step.target.width, step.target.height,
        )  # fmt: skip
        if self.due(fit):
            largest = np.exp(fit.packed[:, 7:10]).max(1)
            clone, split = numerics.density.choose(
                self.statistics, largest, small=s.percent_dense * fit.extent, absgrad=s.absgrad,
                grad_threshold=s.densify_grad_threshold,
                abs_grad_threshold=s.densify_abs_grad_threshold,
                room=s.max_gaussians - len(fit.packed),
            )  # fmt: skip
            keep = fit.packed[:, 10] > logit(s.prune_opacity)
            fit.replace(*numerics.density.grow(fit.packed, clone, split, keep, fit.random))
        if self.reset_due(fit):
            self.latest = fit.iteration
            ceiling = np.float32(logit(2 * s.prune_opacity))
            fit.packed[:, 10] = np.minimum(fit.packed[:, 10], ceiling)
            fit.adam.first[:, 10] = 0
            fit.adam.second[:, 10] = 0

    def select(self, source: Indices, fresh: Bools) -> None:
        self.statistics = self.statistics.empty(len(source))


class Mcmc(
    Density, switch="densify",
    present={"densify": True, "strategy": "mcmc", "opacity_reg": 0.01, "scale_reg": 0.01},
):  # fmt: skip
    """The dead move to the living, and noise keeps the positions exploring."""

    class Settings(PartSettings):
        noise_lr: Weight = 5e5
        """mcmc: noise, relative to the learning rate of positions"""
        opacity_reg: Weight = 0.0
        """weight of the mean opacity in the loss (mcmc: 0.01)"""
        scale_reg: Weight = 0.0
        """weight of the mean scale in the loss (mcmc: 0.01)"""

    def follow(self, fit: Trainer, step: Step) -> None:
        numerics.density.add_noise(
            fit.packed, self.settings.noise_lr * float(step.rates[0]), fit.random
        )

    def populate(self, fit: Trainer, step: Step) -> None:
        s = self.settings
        if self.due(fit):
            fit.replace(
                *numerics.density.relocate(fit.packed, s.prune_opacity, s.max_gaussians, fit.random)
            )


class Isotropic(Part, switch="isotropic", on=True, off=False):
    """Opacity and scale have a price, and scales may be kept equal."""

    class Settings(PartSettings):
        isotropic: bool = False
        """keep the three scales of each Gaussian equal (with hold_surface and detail false only)"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        s = fit.settings
        return cls(fit) if s.isotropic or s.opacity_reg > 0 or s.scale_reg > 0 else None

    def guide(self, fit: Trainer, step: Step) -> None:
        s, gradient = self.settings, step.gradients.packed
        numerics.density.add_regularisers(fit.packed, gradient, s.opacity_reg, s.scale_reg)
        if s.isotropic:
            gradient[:, 7:10] = gradient[:, 7:10].mean(1, keepdims=True)

    def pace(self, step: Step) -> None:
        if self.settings.isotropic:
            step.rates[3:7] = 0


class Floaters(
    Part, switch="",
    absent={
        "final_prune_contribution": 0.0, "final_prune_near": 0.0, "final_prune_masked": 0.0,
        "final_prune_empty": 1.0,
    },
):  # fmt: skip
    """What is transparent goes in any case."""

    class Settings(PartSettings):
        final_prune_contribution: Weight = 0.05
        """at the end, remove Gaussians that colour less than this many pixels in every view"""
        final_prune_near: Annotated[float, Field(ge=0, lt=1)] = 0.5
        """finally remove Gaussians nearer to a view than this share of its nearest depth"""
        final_prune_masked: AutoFloat = automatic({3: 0.2}, held=0.0, le=1)
        """finally remove Gaussians with less than this share of their area inside the masks: they
        have grown out of them (a held surface has a rim and no needles)"""
        final_prune_empty: AutoFloat = automatic({3: 0.8, 6: 1.0}, le=1)
        """finally remove Gaussians where nothing was measured, with more than this share of their
        area where photographs look like the background behind everything: nobody misses them
        there, and from elsewhere they are specks (many views know better)"""

    def __init__(self, fit: Trainer) -> None:
        self.positions, self.removed = fit.scene.cloud.positions, 0

    def end(self, fit: Trainer) -> None:
        keep = worth_keeping(fit, self.positions)
        if not keep.any():
            raise ReconstructionError(
                "Nothing is left of the fit: all Gaussians were pruned at its end. Unless that is "
                "by fit.final_prune_contribution or another setting of yours, the points and the "
                "cameras that it started from don't agree; look at what align and sap made of them."
            )
        self.removed = int((~keep).sum())
        rows = np.flatnonzero(keep)
        fit.replace(np.ascontiguousarray(fit.packed[keep]), rows, np.zeros(len(rows), bool))

    def summary(self) -> Figures:
        return {"pruned_at_end": self.removed}


def contribution(rendering: Rendering, mask: Floats, empty: Floats) -> Floats:
    """Sum over pixels of each Gaussian's blending weight: the area that it colours, in pixels.

    Args:
        rendering: of one view.
        mask: [H, W] float32, 1 where the view's photograph may be used.
        empty: [H, W] float32, 1 where it also looks like the background.

    Returns:
        [3, N] over the whole image, inside the mask only, and where it is empty only.
    """
    per_pixel = np.zeros_like(rendering.planes)
    per_pixel[:3] = np.ones_like(mask), mask, mask * empty
    gradients = rendering.backward(per_pixel, np.zeros_like(rendering.transmittance))
    return np.ascontiguousarray(gradients.features[:, :3].T)


def looks_empty(fit: Trainer, view: int) -> Floats:
    """[H, W] float32, 1 where a photograph looks like the background, if that has a colour."""
    photograph = fit.targets[view][1].colour.target
    behind = fit.find(Background)
    if behind is None or not behind.values.any():
        return np.zeros(photograph.shape[1:], np.float32)
    scale = np.sqrt(photograph[0].size / PIXELS)
    return numerics.background.looks_like(photograph, fit.without_gaussians(view), scale)


def in_picture(points: AnyArray, viewpoint: Viewpoint) -> tuple[Any, Bools]:
    """[N] depths of points [N, 3] in a view, and which of them its image shows."""
    turn = viewpoint.pose[:, :3].T.astype(points.dtype)
    local = points @ turn + viewpoint.pose[:, 3]
    z = np.maximum(local[:, 2], points.dtype.type(1e-6))
    fx, fy, cx, cy = viewpoint.intrinsics
    u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
    inside = (u >= 0) & (u < viewpoint.width) & (v >= 0) & (v < viewpoint.height)
    return local[:, 2], inside & (local[:, 2] > 0)


def before_lens(packed: Floats, viewpoints: Sequence[Viewpoint], nearest: Sequence[float]) -> Bools:
    """[N] Gaussians that lie inside a view's frustum and nearer than `nearest` of that view."""
    close = np.zeros(len(packed), bool)
    for viewpoint, limit in zip(viewpoints, nearest, strict=True):
        depths, inside = in_picture(packed[:, :3], viewpoint)
        close |= inside & (depths < limit)
    return close


def worth_keeping(fit: Trainer, positions: Array) -> Bools:
    """[N] False for Gaussians that colour nothing or what is empty, and for those before a lens.

    What a Gaussian colours outside the masks, no photograph has a say in: one that does mostly
    that is a needle that has grown into the masked part.
    """
    s = fit.settings
    most, areas = np.zeros(len(fit.packed), np.float32), np.zeros((3, len(fit.packed)), np.float32)
    viewpoints, nearest = [], []
    for view, target in enumerate(fit.targets):
        here = contribution(fit.render(view), target[1].colour.mask, looks_empty(fit, view))
        most = np.maximum(most, here[1])
        areas += here
        viewpoint = fit.viewpoint(view, target[1])
        depths, inside = in_picture(positions, viewpoint)
        limit = float(np.quantile(depths[inside], 0.01)) if inside.any() else 0.0
        viewpoints.append(viewpoint)
        nearest.append(s.final_prune_near * limit)
    everywhere, within, empty = areas
    keep = (most >= s.final_prune_contribution) & (within >= s.final_prune_masked * everywhere)
    unseen = np.flatnonzero(empty > s.final_prune_empty * within)
    measured = fit.scene.cloud.positions[fit.scene.trusted]
    keep[unseen] &= numerics.background.near_measured(fit.packed[unseen, :3], measured)
    keep &= fit.packed[:, 10] > logit(s.prune_opacity)
    return np.asarray(keep & ~before_lens(fit.packed, viewpoints, nearest))
