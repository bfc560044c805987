"""The surface of the input points: Gaussians are held to it, and it bends as a whole.

See `numerics.surface`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.artifacts.confidence import MEASURED
from stages.fit import numerics
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.parts.base import Figures, Part, Step, interpolate
from stages.fit.parts.light import Light
from stages.fit.settings import (
    AUTO,
    AutoBool,
    AutoFloat,
    PartSettings,
    Positive,
    Share,
    automatic,
)

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Camera
    from stages.fit.config import FitSettings
    from stages.fit.trainer import Trainer

#: up to so many views, a surface can be held: at four, holding cost .2 to 1.5 dB on two generated
#: mouths and a scan, at five it gained .2 to .4 on the mouths
FEW_VIEWS = 3
#: and one is, where a view is further from the nearest other one than this (degrees): there matches
#: of features end. A patient's three photographs, 28 degrees apart: 34.2 dB, not 28.1
LONELY = 22.0
#: how far behind a surface its lining is, in standard deviations of the Gaussian before it. 1.2 to
#: 3.5 look the same, from 1.2 on down it shines through; the depth that is rendered lies .6 pixels
#: of 512 px photographs further back by it (2.5: .9), and on six generated mouths nearer the truth
BEHIND = 1.8
#: how many times as wide it is, for every one of those that is lined: neighbours overlap
WIDTH = 2.0
#: and at least so many of its own from where the surface ends, or it would be seen beyond
CLEAR = 2.0
#: what ``warp_slope: auto`` comes to, with a light beside the lens and without
SLOPE_LIT, SLOPE = 2.0, 0.3
#: pixels, the least spacing of splines: what is finer no photograph can tell
FINEST = 5.0


class Surface(
    Part, switch="hold_surface", on=True, off=False, needs=("cloud",), kept=("anchor", "turn")
):
    """Where each Gaussian belongs, and how firmly.

    Attributes:
        anchor, turn: as `numerics.surface.pull` has them.
    """

    class Settings(PartSettings):
        hold_surface: AutoBool = automatic(
            f"up to {FEW_VIEWS} views, one or more of them {LONELY:g} degrees from the others",
            ge=None,
        )
        """keep Gaussians flat and on the surface of the input points, in proportion to
        confidence"""
        hold_strength: Share = 0.15
        """share of the way back that a sure Gaussian goes after each step"""
        hold_flatness: Annotated[float, Field(gt=0, le=1)] = 0.6
        """thickness of held Gaussians, relative to their width"""
        hold_growth: Annotated[float, Field(ge=1)] = 2.0
        """by which factor Gaussians of a held scene may get wider than they start"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        s, cloud, packed = self.settings, fit.cloud, fit.packed
        assert cloud is not None
        numerics.surface.along_normals(packed, cloud.normals, s.hold_flatness)
        # the median of what was measured is sure
        measured = cloud.weight[cloud.weight > MEASURED]
        sure = float(np.median(measured)) if len(measured) else 2.0
        firmness = np.clip((cloud.weight - 1) / (sure - 1), 0, 1) * s.hold_strength
        firmness = firmness * (np.abs(cloud.normals).sum(1) > 0)
        widest = packed[:, 7:9].max(1, keepdims=True) + np.log(s.hold_growth)
        columns = [packed[:, :3], cloud.normals, packed[:, 9:10], firmness[:, None], widest]
        self.anchor: Floats = np.concatenate(columns, 1).astype(np.float32)
        self.turn: Floats = packed[:, 3:7].copy()

    def follow(self, fit: Trainer, step: Step) -> None:
        numerics.surface.pull(fit.packed, self.anchor, self.turn)

    def bend(self, move: Floats, normals: Floats) -> None:
        """Go with a surface whose points have moved by [N, 3] and face [N, 3] (unit, or 0) now."""
        self.turn = numerics.surface.turned(self.turn, self.anchor[:, 3:6], normals)
        self.anchor[:, :3] += move
        self.anchor[:, 3:6] = normals

    def shrink(self, rows: Bools, factor: float) -> None:
        """Gaussians [N] are smaller from now on, in all that they may be."""
        for column in (6, 8):
            self.anchor[rows, column] += np.float32(np.log(factor))

    def recede(self, first: int, move: Floats, widest: Floats) -> None:
        """Gaussians from row `first` on belong by [N - first, 3] elsewhere, and may be so wide (log
        standard deviation)."""
        self.anchor[first:, :3] += move
        self.anchor[first:, 8] = widest

    def select(self, source: Indices, fresh: Bools) -> None:
        self.anchor = np.ascontiguousarray(self.anchor[source])
        self.turn = np.ascontiguousarray(self.turn[source])


class Lining(Part, switch="lining", on=0.25, off=0.0, needs=("cloud",)):
    """Few, wide Gaussians behind a held surface, so that no black shows between those on it.

    A photograph fills what is between Gaussians narrower than its pixels, by the low-pass that all
    are drawn with, and black behind them is the cheapest way to a dark line. Both open where the
    scene is looked at from nearer than the photograph was taken, or from elsewhere: black cracks.
    What lines them has about their colour. It follows the photographs as all Gaussians do, and
    what nothing lets through is pruned in the end.

    Twelve patients at 512 px (mean, standard error): drawn twice as large 36.1 dB, not 33.2 (.2);
    each photograph from the other two .32 dB better (.04); the photographs themselves .8 (.3).
    """

    class Settings(PartSettings):
        lining: AutoFloat = automatic({3: 0.0}, held=0.25, le=1)
        """where a surface is held and there is no light, about the share of its Gaussians that get
        one behind them, so that no black shows between them from nearer or elsewhere; 0: none"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        # under a light they come out grey: colours that nothing tells well, on a scan -.23 dB
        return super().of(fit) if fit.settings.hold_surface and not fit.lit else None

    def begin(self, fit: Trainer) -> None:
        if fit.iteration:
            return
        surface = fit.find(Surface)
        assert surface is not None
        every = round(1 / self.settings.lining)
        wider = np.float32(np.log(WIDTH * np.sqrt(every)))
        chosen, inland = numerics.surface.inland(
            fit.packed[:, :3].astype(np.float64), surface.anchor[:, 3:6].astype(np.float64), every
        )
        # no photograph would draw them back from beyond the rim
        most = np.log(np.maximum(inland, 1e-9) / CLEAR).astype(np.float32)
        fits = fit.packed[chosen, 7:10].max(1) + wider < most
        chosen, most = chosen[fits], most[fits]
        number = len(fit.packed)
        source = np.concatenate([np.arange(number), chosen])
        packed = fit.packed[source]
        scales = packed[number:, 7:10]
        move = -BEHIND * np.exp(scales.max(1, keepdims=True)) * surface.anchor[chosen, 3:6]
        packed[number:, :3] += move
        scales += wider * (np.arange(3) != scales.argmin(1)[:, None])
        widest = np.minimum(surface.anchor[chosen, 8] + wider, most)
        fit.replace(packed, source, np.arange(len(source)) >= number)
        surface.recede(number, move, widest)


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
        """spacing of the finest of these splines, as a share of the scene's depth; never less than
        five pixels"""
        warp_slope: AutoFloat = automatic(
            f"{SLOPE_LIT} with a light beside the lens; {SLOPE} without, where highlights "
            "that move would tear the surface",
            ge=1e-3,
        )
        """no width of splines gets steeper than about this"""
        # on a held surface nothing else moves it
        warp_lr_init: AutoFloat = automatic({3: 1e-4}, held=6e-4)
        """learning rate of the splines at the start, as a share of the scene's depth"""
        warp_lr_final: AutoFloat = automatic({3: 1e-5}, held=2e-4)
        """learning rate of the splines at the end"""

    def __init__(self, fit: Trainer) -> None:
        s, scene, cloud = fit.settings, fit.scene, fit.cloud
        assert cloud is not None
        self.rates = s.warp_lr_init, s.warp_lr_final
        pixel = 1 / max(camera.fx for camera in scene.cameras)
        self.bend = numerics.surface.Warp(
            cloud.positions, cloud.normals, max(s.warp_spacing, FINEST * pixel),
            s.warp_levels, steepest(s, fit.lit), len(scene.views),
        )  # fmt: skip

    def guide(self, fit: Trainer, step: Step) -> None:
        """Let the surface as a whole follow the gradients of the Gaussians on it."""
        light, surface, bend = fit.find(Light), fit.find(Surface), self.bend
        by_normal = None if light is None else light.by_normal
        bend.collect(step.gradients.packed[:, :3], by_normal)
        before = bend.facing
        bent = bend.move(interpolate(*self.rates, step.done))
        if bent is None:
            return
        fit.packed[:, :3] += bent.move
        fit.packed[:, 3:7] = numerics.surface.turned(fit.packed[:, 3:7], before, bend.facing)
        if light is not None:
            light.material[:, 3:] += bent.lean
        if surface is not None:
            surface.bend(bent.move, bend.facing)

    def select(self, source: Indices, fresh: Bools) -> None:
        self.bend.select(source)

    def summary(self) -> Figures:
        return {"surface_bent": round(self.bend.reach(), 5)}


def steepest(s: FitSettings, lit: bool) -> float:
    """The slope that a warp may have: more where highlights are not taken for shape."""
    given: Any = s.warp_slope
    return float(given) if given != AUTO else SLOPE_LIT if lit else SLOPE


def worth_holding(cameras: Sequence[Camera], positions: Array) -> bool:
    """What ``hold_surface: auto`` comes to.

    Where a view is too far from all others to be matched, the points that it shows are a surface
    that was inferred as a whole, and the photographs can't correct it. Where all overlap closely,
    holding costs more than it gives.

    Args:
        cameras: the placed ones.
        positions: [N, 3] the points, in the world of the cameras.
    """
    if not 2 <= len(cameras) <= FEW_VIEWS:
        return False
    rays = np.array([camera.centre for camera in cameras]) - np.median(positions, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1)
    loneliest = np.degrees(np.arccos(np.clip(cosines.max(0).min(), -1, 1)))
    return bool(loneliest > LONELY)
