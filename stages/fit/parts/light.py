"""A light beside the lens gives the colours, in place of spherical harmonics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from pipeline.artifacts import gaussians as artifacts
from stages.fit import numerics
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.parts.base import Part, Step
from stages.fit.parts.objectives import Variation
from stages.fit.settings import (
    AutoFloat,
    Count,
    PartSettings,
    automatic,
)

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Viewpoint


#: bounds of the scene's light, in the order of `Light.values`: what no tissue and no flash
#: exceeds. They keep a wrong start from running away.
LOWEST = np.array([0.0, 0.0, 20.0, 1e-3, 2.0, 1e-4])
HIGHEST = np.array([0.98, 4.0, 2000.0, 5.0, 40.0, 1.0])
#: the same of what a user says of the narrow lobe and of the broad one
Widths = tuple[Annotated[float, Field(ge=20, le=2000)], Annotated[float, Field(ge=2, le=40)]]
Strengths = tuple[Annotated[float, Field(ge=1e-3, le=5)], Annotated[float, Field(ge=1e-4, le=1)]]
if TYPE_CHECKING:
    AutoStrengths = Strengths
else:
    AutoStrengths = Literal["auto"] | Strengths
#: steps after which normals are made unit again: only their direction means something, but their
#: length is what Adam's step is relative to
RENORMALISE = 10
#: learning rates of logit k and of the lobes' log widths, and of the falloff's exponent
RATE, FALLOFF_RATE = 1e-2, 5e-3
#: what these, albedos' and normals' rates have fallen to at the end
DECAY = 0.1


class Light(
    Part, switch="light", on="camera", off="none",
    kept=("material", "values", "first", "second", "adam.first", "adam.second", "adam.steps"),
):  # fmt: skip
    """Attributes:
    material: [N, 6] float32, albedo and normal.
    values: [6] float64: k, p, m and s of the narrow lobe, m and s of the broad one.
    by_normal: [N, 3] float32 gradient of the last step by the normals.
    """

    class Settings(PartSettings):
        light: Literal["auto", "camera", "none"] = "auto"
        """a light beside the lens: albedo, normals, falloff and highlights in place of spherical
        harmonics (auto: where a trial predicts held-out photographs better with it; on a
        held surface where it explains how colours change between photographs, and comes as near to
        them as none does)"""
        light_diffuse: Annotated[float, Field(gt=0, lt=0.98)] = 0.9
        """share k of light that comes from the lens: 1 - k + k n.v, to start with"""
        light_falloff: Annotated[float, Field(ge=0, le=4)] = 2.0
        """exponent of the light's falloff, to start with"""
        light_widths: Widths = (200.0, 25.0)
        """exponents m of the narrow and broad highlight lobe, to start with"""
        light_strengths: AutoStrengths = automatic({3: (0.5, 0.04)}, held=(0.3, 0.04), ge=None)
        """strengths of the two lobes in linear light, to start with"""
        light_gamma: Annotated[float, Field(ge=1, le=4)] = 2.2
        """exponent of the photographs' encoding"""
        # in colour, not in harmonics: C0 times the rate of those. On a held surface neighbours
        # pass on to one another what they are
        light_albedo_lr: AutoFloat = automatic({3: 1.4e-3, 6: 4.2e-3}, held=0.03)
        """learning rate of albedos"""
        light_normal_lr: AutoFloat = automatic({3: 5e-3}, held=4e-3)
        """learning rate of the normals that are lit"""
        light_strength_lr: AutoFloat = automatic({3: 2e-2}, held=0.0)
        """learning rate of the lobes' log strengths: views too far apart to share a highlight bend
        normals until any strength fits"""
        light_trial_iterations: Count = 300
        """steps of each trial of light: auto"""
        light_trial_factor: Annotated[int, Field(ge=1, le=16)] = 4
        """by which factor its images are reduced"""

    def __init__(self, fit: Trainer) -> None:
        from stages.splatting.adam import Adam

        super().__init__(fit)
        s, scene, cloud = self.settings, fit.scene, fit.cloud
        assert cloud is not None
        images = [view.image for view in scene.views]
        masks = [view.valid() for view in scene.views]
        self.material = numerics.light.initial_material(
            cloud, scene.cloud.positions, images, masks, scene.cameras, s
        )
        self.values = np.array(
            [s.light_diffuse, s.light_falloff, s.light_widths[0], s.light_strengths[0],
             s.light_widths[1], s.light_strengths[1]], np.float64,
        )  # fmt: skip
        self.adam = Adam(self.material.shape)
        self.first, self.second = np.zeros(6), np.zeros(6)
        self.radiance: Floats = np.empty((0, 3), np.float32)
        self.by_normal: Floats = np.empty((0, 3), np.float32)

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        return super().of(fit) if fit.lit else None

    def coefficients(self) -> Floats:
        """[8] for `shade`. In the frame of a fit the scene's depth is 1: the falloff's distance."""
        return np.array([*self.values, 1.0, self.settings.light_gamma], np.float32)

    def shade(self, packed: Floats, viewpoint: Viewpoint) -> None:
        from stages.splatting.light import shade

        self.radiance = shade(packed, self.material, viewpoint.centre, self.coefficients())

    def guide(self, fit: Trainer, step: Step) -> None:
        """One step of material and light; what reaches positions and camera is added."""
        from stages.splatting.light import shade_backward

        s, gradient, variation = self.settings, step.gradients.packed, fit.find(Variation)
        result = shade_backward(
            fit.packed, self.material, step.viewpoint.centre, step.viewpoint.pose,
            self.coefficients(), self.radiance, gradient,
        )  # fmt: skip
        gradient[:, 11:14] = 0
        if variation is not None:
            variation.add(fit, self.material, 0, 3, result.material)
        fall = DECAY**step.done
        rates = np.empty(6, np.float32)
        rates[:3], rates[3:] = s.light_albedo_lr * fall, s.light_normal_lr * fall
        self.by_normal = result.material[:, 3:]
        self.adam.step(self.material, result.material, rates)
        self._not_black()
        if self.adam.steps % RENORMALISE == 0:
            self.material[:, 3:] = self.normals()
        self._step_light(result.light, fall)
        step.by_pose = step.by_pose + result.pose

    def _step_light(self, gradient: Array, fall: float) -> None:
        """Adam on logit k, p, and the logarithms of the lobes' widths and strengths."""
        k, by_strength = self.values[0], self.settings.light_strength_lr
        slope = self.values.copy()  # of the values by what Adam moves
        slope[0], slope[1] = k * (1 - k), 1
        g = gradient * slope
        rates = np.array([RATE, FALLOFF_RATE, RATE, by_strength, RATE, by_strength])
        step, self.first, self.second = numerics.moments.adam_step(
            g, self.first, self.second, self.adam.steps, fall * rates, 0.99
        )
        move = -step
        odds = k / (1 - k) * np.exp(move[0])
        moved = self.values * np.exp(move)
        moved[0], moved[1] = odds / (1 + odds), self.values[1] + move[1]
        self.values = np.clip(moved, LOWEST, HIGHEST)

    def by_albedo(self, packed: Floats, viewpoint: Viewpoint) -> Floats:
        """[N, 3] slope of the colours that a view sees, by the albedos."""
        from stages.splatting.kernels.features import C0
        from stages.splatting.kernels.projection import HARMONICS
        from stages.splatting.light import shade_backward

        self.shade(packed, viewpoint)
        one = np.zeros_like(packed)
        one[:, HARMONICS : HARMONICS + 3] = C0  # a colour is .5 + C0 times its harmonic
        slopes = shade_backward(
            packed, self.material, viewpoint.centre, viewpoint.pose, self.coefficients(),
            self.radiance, one,
        )  # fmt: skip
        return slopes.material[:, :3].copy()

    def brighten(self, move: Floats) -> None:
        """Add [N, 3] to the albedos."""
        self.material[:, :3] += move
        self._not_black()

    def _not_black(self) -> None:
        # a black albedo has no slope to come back by
        np.maximum(self.material[:, :3], np.float32(2e-3), out=self.material[:, :3])

    def normals(self) -> Floats:
        """[N, 3] unit normals."""
        normals = self.material[:, 3:]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.maximum(length, np.float32(1e-12)), np.float32)

    def select(self, source: Indices, fresh: Bools) -> None:
        self.material = np.ascontiguousarray(self.material[source])
        self.adam.select(source, fresh)

    def light(self, scale: float) -> artifacts.Light:
        """What was fitted, with lengths in units of 1 / `scale`."""
        k, p, m1, s1, m2, s2 = (float(value) for value in self.values)
        return artifacts.Light(
            self.material[:, :3].copy(), self.normals(), diffuse_share=k, falloff=p,
            distance=scale, widths=(m1, m2), strengths=(s1, s2), gamma=self.settings.light_gamma,
        )  # fmt: skip
