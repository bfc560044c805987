"""A light beside the lens gives the colours, in place of spherical harmonics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from stages.fit.parts.base import Bools, Floats, Indices, Part, Step
from stages.fit.parts.objectives import Variation
from stages.fit.settings import (
    AutoFloat,
    AutoPair,
    Count,
    Pair,
    PartSettings,
    Share,
    Weight,
    Whole,
    automatic,
)

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Viewpoint


class Light(
    Part, switch="light", on="camera", off="none",
    kept=("model.material", "model.values", "model.first", "model.second", "model.adam.first",
          "model.adam.second", "model.adam.steps"),
):  # fmt: skip
    """Attributes:
    model: material and light, with their optimisers.
    """

    class Settings(PartSettings):
        light: Literal["auto", "camera", "none"] = "auto"
        """a light beside the lens: albedo, normals, falloff and highlights in place of spherical
        harmonics (auto: where a short trial predicts a held-out photograph better with it; on a
        held surface where it explains how colours change between photographs)"""
        light_diffuse: Annotated[float, Field(gt=0, lt=0.98)] = 0.9
        """share k of light that comes from the lens: 1 - k + k n.v, to start with"""
        light_falloff: Annotated[float, Field(ge=0, le=4)] = 2.0
        """exponent of the light's falloff, to start with"""
        light_widths: Pair = (200.0, 25.0)
        """exponents m of the narrow and broad highlight lobe, to start with"""
        light_strengths: AutoPair = automatic({3: (0.5, 0.04)}, held=(0.3, 0.04), ge=None)
        """strengths of the two lobes in linear light, to start with"""
        light_gamma: Annotated[float, Field(ge=1, le=4)] = 2.2
        """exponent of the photographs' encoding"""
        # in colour, not in harmonics: C0 times the rate of those. On a held surface neighbours
        # pass on to one another what they are
        light_albedo_lr: AutoFloat = automatic({3: 1.4e-3, 6: 4.2e-3}, held=5e-3)
        """learning rate of albedos"""
        light_normal_lr: AutoFloat = automatic({3: 5e-3}, held=2e-3)
        """learning rate of the normals that are lit"""
        light_lr: Weight = 1e-2
        """learning rate of logit k and of the lobes' log widths"""
        light_falloff_lr: Weight = 5e-3
        """learning rate of the falloff's exponent"""
        light_strength_lr: AutoFloat = automatic({3: 2e-2}, held=0.0)
        """learning rate of the lobes' log strengths: views too far apart to share a highlight bend
        normals until any strength fits"""
        light_lr_decay: Annotated[float, Field(gt=0, le=1)] = 0.1
        """what the light's, albedos' and normals' rates have fallen to at the end"""
        light_sh_iterations: Whole = 120
        """steps at reduced size that fit the spherical harmonics of the .ply to the lit scene"""
        light_sh_rest_lr: Weight = 5e-3
        """learning rate of the harmonics above the constant in those steps"""
        light_trial_iterations: Count = 100
        """steps of each trial of light: auto"""
        light_trial_points: Annotated[int, Field(ge=100)] = 6000
        """Gaussians of each trial of light: auto"""
        light_trial_factor: Annotated[int, Field(ge=1, le=16)] = 4
        """by which factor its images are reduced"""
        light_margin: Weight = 0.1
        """dB by which the trial with a light has to be better on the held-out photograph"""
        light_evidence: Share = 0.7
        """on a held surface there is a light if its shading lowers the error of predicting the
        photographs from one another to this share"""

    def __init__(self, fit: Trainer) -> None:
        from stages.fit.numerics.lens_light import LensLight, initial_material

        scene, cloud = fit.scene, fit.cloud
        assert scene is not None and cloud is not None
        images = [view.image for view in scene.views]
        masks = [view.valid() for view in scene.views]
        material = initial_material(
            cloud, scene.cloud.positions, images, masks, scene.cameras, fit.settings
        )
        self.model = LensLight(material, fit.settings)

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        return super().of(fit) if fit.lit else None

    def shade(self, packed: Floats, viewpoint: Viewpoint) -> None:
        self.model.shade(packed, viewpoint)

    def guide(self, fit: Trainer, step: Step) -> None:
        variation = fit.find(Variation)
        graph = None if variation is None else variation.graph
        step.by_pose = step.by_pose + self.model.step(
            fit.packed, step.viewpoint, step.gradients, graph, step.done
        )

    def select(self, source: Indices, fresh: Bools) -> None:
        self.model.select(source, fresh)
