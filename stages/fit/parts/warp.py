"""The surface of the points bends as a whole (see `numerics.warp`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from stages.fit.parts.base import Bools, Figures, Indices, Part, Step, interpolate
from stages.fit.parts.light import Light
from stages.fit.parts.surface import Surface
from stages.fit.settings import AUTO, AutoFloat, PartSettings, Positive, automatic

if TYPE_CHECKING:
    from stages.fit.config import FitSettings
    from stages.fit.trainer import Trainer

#: what ``warp_slope: auto`` comes to, with a light beside the lens and without
SLOPE_LIT, SLOPE = 2.0, 0.3


class Warp(
    Part, switch="warp_levels", off=0, needs=("cloud",),
    kept=("bend.field.coefficients", "bend.field.nodes", "bend.field.offsets", "bend.normals",
          "bend.facing", "bend.shape", "bend.gradient", "bend.adam.first", "bend.adam.second",
          "bend.adam.steps", "bend.collected"),
):  # fmt: skip
    """Attributes:
    bend: how the surface is bent.
    """

    class Settings(PartSettings):
        warp_levels: Annotated[int, Field(ge=0, le=8)] = 4
        """bend the surface of the points as a whole by splines of so many widths, each twice the
        one before; 0: Gaussians only move on their own"""
        warp_spacing: Positive = 0.01
        """spacing of the finest of these splines, as a share of the scene's depth"""
        warp_spacing_px: Positive = 5.0
        """and no less than so many pixels: what is finer no photograph can tell"""
        warp_slope: AutoFloat = automatic(
            f"{SLOPE_LIT} with a light beside the lens; {SLOPE} without, where highlights "
            "that move would tear the surface",
            ge=1e-3,
        )
        """no width of splines gets steeper than about this"""
        # on a held surface nothing else moves it
        warp_lr_init: AutoFloat = automatic({3: 1e-4}, held=3e-4)
        """learning rate of the splines at the start, as a share of the scene's depth"""
        warp_lr_final: AutoFloat = automatic({3: 1e-5}, held=1e-4)
        """learning rate of the splines at the end"""

    def __init__(self, fit: Trainer) -> None:
        from stages.fit.numerics import warp

        s, scene, cloud = fit.settings, fit.scene, fit.cloud
        assert scene is not None and cloud is not None
        self.rates = s.warp_lr_init, s.warp_lr_final
        pixel = 1 / max(camera.fx for camera in scene.cameras)
        self.bend = warp.Warp(
            cloud.positions, cloud.normals, max(s.warp_spacing, s.warp_spacing_px * pixel),
            s.warp_levels, steepest(s, fit.lit), len(scene.views),
        )  # fmt: skip

    def guide(self, fit: Trainer, step: Step) -> None:
        """Let the surface as a whole follow the gradients of the Gaussians on it."""
        from stages.fit.numerics.warp import turned

        light, surface, bend = fit.find(Light), fit.find(Surface), self.bend
        if surface is not None and surface.still(step.done):
            return
        by_normal = None if light is None else light.model.by_normal
        bend.collect(step.gradients.packed[:, :3], by_normal)
        before = bend.facing
        bent = bend.move(interpolate(*self.rates, step.done))
        if bent is None:
            return
        fit.packed[:, :3] += bent.move
        fit.packed[:, 3:7] = turned(fit.packed[:, 3:7], before, bend.facing)
        if light is not None:
            light.model.material[:, 3:] += bent.lean
        if surface is not None:
            surface.anchors.follow(bent.move, bend.facing)

    def select(self, source: Indices, fresh: Bools) -> None:
        self.bend.select(source)

    def summary(self) -> Figures:
        return {"surface_bent": round(self.bend.reach(), 5)}


def steepest(s: FitSettings, lit: bool) -> float:
    """The slope that a warp may have: more where highlights are not taken for shape."""
    given: Any = s.warp_slope
    return float(given) if given != AUTO else SLOPE_LIT if lit else SLOPE
