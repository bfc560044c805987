"""Gaussians are held to the surface of the input points (see `numerics.surface`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from stages.fit.parts.base import Array, Bools, Indices, Part, Step
from stages.fit.settings import AutoBool, PartSettings, Share, automatic

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Camera
    from stages.fit.trainer import Trainer

#: up to so many views, a surface can be held
FEW_VIEWS = 3


class Surface(
    Part, switch="hold_surface", on=True, off=False, needs=("cloud",),
    kept=("anchors.anchor", "anchors.turn"),
):  # fmt: skip
    """Attributes:
    anchors: where each Gaussian belongs.
    """

    class Settings(PartSettings):
        hold_surface: AutoBool = automatic("up to 3 views that are far apart")
        """keep Gaussians flat and on the surface of the input points, in proportion to
        confidence"""
        hold_min_angle: Annotated[float, Field(ge=0, le=180)] = 22.0
        """hold_surface auto: neighbouring views further apart than this, degrees"""
        hold_strength: Share = 0.15
        """share of the way back that a sure Gaussian goes after each step"""
        hold_flatness: Annotated[float, Field(gt=0, le=1)] = 0.6
        """thickness of held Gaussians, relative to their width"""
        hold_growth: Annotated[float, Field(ge=1)] = 2.0
        """by which factor Gaussians of a held scene may get wider than they start"""
        hold_colors_until: Share = 0.0
        """up to this share of the iterations, held Gaussians change colour only"""

    def __init__(self, fit: Trainer) -> None:
        from stages.fit.numerics.surface import HeldSurface, along_normals

        s, cloud = fit.settings, fit.cloud
        assert cloud is not None
        self.until = s.hold_colors_until
        along_normals(fit.packed, cloud.normals, s.hold_flatness)
        self.anchors = HeldSurface(
            fit.packed, cloud.normals, cloud.weight, s.hold_strength, s.hold_growth
        )

    def still(self, done: float) -> bool:
        """Whether Gaussians change colour only."""
        return done < self.until

    def pace(self, step: Step) -> None:
        if self.still(step.done):
            step.rates[:11] = 0

    def follow(self, fit: Trainer, step: Step) -> None:
        self.anchors.pull(fit.packed)

    def select(self, source: Indices, fresh: Bools) -> None:
        self.anchors.select(source)


def worth_holding(cameras: Sequence[Camera], positions: Array, least_angle: float) -> bool:
    """What ``hold_surface: auto`` comes to.

    Where neighbouring views are too far apart to be matched, the points are a surface that was
    inferred as a whole, and the photographs can't correct it. Where views do overlap closely,
    holding costs more than it gives.

    Args:
        cameras: the placed ones.
        positions: [N, 3] the points, in the world of the cameras.
        least_angle: degrees that every two views are apart, seen from the middle of the points.
    """
    if not 2 <= len(cameras) <= FEW_VIEWS:
        return False
    rays = np.array([camera.centre for camera in cameras]) - np.median(positions, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1)
    closest = np.degrees(np.arccos(np.clip(cosines.max(), -1, 1)))
    return bool(closest > least_angle)
