"""What a finished fit does without: Gaussians that no view needs, and those before the lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from pipeline.errors import ReconstructionError
from stages.fit.parts.base import Array, Bools, Figures, Floats, Part, logit
from stages.fit.settings import AutoFloat, PartSettings, Weight, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Rendering, Viewpoint


class Floaters(
    Part, switch="", needs=("scene",),
    absent={"final_prune_contribution": 0.0, "final_prune_near": 0.0, "final_prune_masked": 0.0},
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

    def __init__(self, fit: Trainer) -> None:
        assert fit.scene is not None
        self.positions, self.removed = fit.scene.cloud.positions, 0

    def end(self, fit: Trainer) -> None:
        keep = worth_keeping(fit, self.positions)
        if not keep.any():
            raise ReconstructionError(
                "Nothing is left of the fit: no Gaussian colours any photograph. The points and "
                "the cameras that it started from don't agree; look at what align and sap made of "
                "them."
            )
        self.removed = int((~keep).sum())
        rows = np.flatnonzero(keep)
        fit.replace(np.ascontiguousarray(fit.packed[keep]), rows, np.zeros(len(rows), bool))

    def summary(self) -> Figures:
        return {"pruned_at_end": self.removed}


def contribution(rendering: Rendering, mask: Floats) -> tuple[Floats, Floats]:
    """Sum over pixels of each Gaussian's blending weight: the area that it colours, in pixels.

    Args:
        rendering: of one view.
        mask: [H, W] float32, 1 where the view's photograph may be used.

    Returns:
        [N] over the whole image, and [N] inside the mask only.
    """
    per_pixel = np.zeros_like(rendering.planes)
    per_pixel[0] = 1
    per_pixel[1] = mask
    gradients = rendering.backward(per_pixel, np.zeros_like(rendering.transmittance))
    areas = gradients.features
    return np.ascontiguousarray(areas[:, 0]), np.ascontiguousarray(areas[:, 1])


def before_lens(packed: Floats, viewpoints: Sequence[Viewpoint], nearest: Sequence[float]) -> Bools:
    """[N] Gaussians that lie inside a view's frustum and nearer than `nearest` of that view."""
    close = np.zeros(len(packed), bool)
    means = packed[:, :3]
    for viewpoint, limit in zip(viewpoints, nearest, strict=True):
        local = means @ viewpoint.pose[:, :3].T + viewpoint.pose[:, 3]
        depth = np.maximum(local[:, 2], np.float32(1e-6))
        fx, fy, cx, cy = viewpoint.intrinsics
        u, v = fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy
        inside = (u >= 0) & (u < viewpoint.width) & (v >= 0) & (v < viewpoint.height)
        close |= (local[:, 2] > 0) & (local[:, 2] < limit) & inside
    return close


def worth_keeping(fit: Trainer, positions: Array) -> Bools:
    """[N] False for Gaussians that colour nothing, and for those right before a lens.

    What a Gaussian colours outside the masks, no photograph has a say in: one that does mostly
    that is a needle that has grown into the masked part.
    """
    s = fit.settings
    most, everywhere, within = np.zeros((3, len(fit.packed)), np.float32)
    viewpoints, nearest = [], []
    for view, target in enumerate(fit.targets):
        area, masked_area = contribution(fit.render(view), target[1].colour.mask)
        most = np.maximum(most, masked_area)
        everywhere += area
        within += masked_area
        viewpoint = fit.viewpoint(view, target[1])
        local = positions @ viewpoint.pose[:, :3].T.astype(np.float64) + viewpoint.pose[:, 3]
        fx, fy, cx, cy = viewpoint.intrinsics
        z = np.maximum(local[:, 2], 1e-6)
        u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
        inside = (local[:, 2] > 0) & (u >= 0) & (u < target[1].width)
        inside &= (v >= 0) & (v < target[1].height)
        depths = local[inside, 2]
        limit = float(np.quantile(depths, 0.01)) if len(depths) else 0.0
        viewpoints.append(viewpoint)
        nearest.append(s.final_prune_near * limit)
    keep = (most >= s.final_prune_contribution) & (within >= s.final_prune_masked * everywhere)
    keep &= fit.packed[:, 10] > logit(s.prune_opacity)
    return np.asarray(keep & ~before_lens(fit.packed, viewpoints, nearest))
