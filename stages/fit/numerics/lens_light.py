"""Fitting a light beside the lens: albedo and normal of each Gaussian, and the scene's light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Light
from stages.fit.config import FitSettings
from stages.fit.initial import Cloud, facing
from stages.fit.numerics.total_variation import TotalVariation
from stages.fit.targets import point_depth
from stages.splatting.adam import Adam
from stages.splatting.light import shade, shade_backward
from stages.splatting.rasterizer import Gradients, Viewpoint

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

#: bounds of the scene's light, in the order of `LensLight.values`: what no tissue and no flash
#: exceeds. They keep a wrong start from running away.
LOWEST = np.array([0.0, 0.0, 20.0, 1e-3, 2.0, 1e-4])
HIGHEST = np.array([0.98, 4.0, 2000.0, 5.0, 40.0, 1.0])
#: steps after which normals are made unit again: only their direction means something, but their
#: length is what Adam's step is relative to
RENORMALISE = 10
#: depth at which a point counts as the surface that a view sees, relative
SAME_SURFACE = 0.02


class LensLight:
    """The material of the Gaussians and the scene's light, with their optimisers.

    Attributes:
        material: [N, 6] float32, albedo and normal.
        values: [6] float64: k, p, m and s of the narrow lobe, m and s of the broad one.
        by_normal: [N, 3] float32 gradient of the last step by the normals.
    """

    def __init__(self, material: Floats, settings: FitSettings) -> None:
        self.settings = settings
        self.material = material
        s = settings
        self.values = np.array(
            [s.light_diffuse, s.light_falloff, s.light_widths[0], s.light_strengths[0],
             s.light_widths[1], s.light_strengths[1]], np.float64,
        )  # fmt: skip
        self.adam = Adam(material.shape, 0.9, 0.999, 1e-15)
        self.first, self.second = np.zeros(6), np.zeros(6)
        self.radiance = np.empty((0, 3), np.float32)
        self.by_normal: Floats = np.empty((0, 3), np.float32)

    def coefficients(self) -> Floats:
        """[8] for `shade`. In the frame of a fit the scene's depth is 1: the falloff's distance."""
        return np.array([*self.values, 1.0, self.settings.light_gamma], np.float32)

    def shade(self, packed: Floats, viewpoint: Viewpoint) -> None:
        """Write the colours that a view shows into a packed scene [N, 14]."""
        self.radiance = shade(packed, self.material, viewpoint.centre, self.coefficients())

    def step(
        self, packed: Floats, viewpoint: Viewpoint, gradients: Gradients,
        variation: TotalVariation | None, done: float,
    ) -> Array:  # fmt: skip
        """One step of material and light after `shade` and the rasterizer's backward pass.

        Args:
            packed, viewpoint: as `shade` had and left them.
            gradients: of the rasterizer; what reaches the positions is added.
            variation: of the albedos, if it counts.
            done: share of the fit that is over, 0..1; rates fall with it.

        Returns:
            [6] gradient of the camera's twist through the light.
        """
        s = self.settings
        result = shade_backward(
            packed, self.material, viewpoint.centre, viewpoint.pose, self.coefficients(),
            self.radiance, gradients.packed,
        )  # fmt: skip
        gradients.packed[:, 11:14] = 0
        if variation is not None:
            variation.add(packed[:, :3], self.material, 0, 3, result.material)
        fall = s.light_lr_decay**done
        rates = np.empty(6, np.float32)
        rates[:3], rates[3:] = s.light_albedo_lr * fall, s.light_normal_lr * fall
        self.by_normal = result.material[:, 3:]
        self.adam.step(self.material, result.material, rates)
        # a black albedo has no slope to come back by
        np.maximum(self.material[:, :3], np.float32(2e-3), out=self.material[:, :3])
        if self.adam.steps % RENORMALISE == 0:
            self.material[:, 3:] = self.normals()
        self._step_light(result.light, fall)
        return result.pose

    def _step_light(self, gradient: Array, fall: float) -> None:
        """Adam on logit k, p, and the logarithms of the lobes' widths and strengths."""
        s = self.settings
        k = self.values[0]
        slope = self.values.copy()  # of the values by what Adam moves
        slope[0], slope[1] = k * (1 - k), 1
        g = gradient * slope
        self.first = 0.9 * self.first + 0.1 * g
        self.second = 0.99 * self.second + 0.01 * g**2
        steps = self.adam.steps
        rates = np.array(
            [s.light_lr, s.light_falloff_lr, s.light_lr, s.light_strength_lr, s.light_lr,
             s.light_strength_lr]
        )  # fmt: skip
        mean, spread = self.first / (1 - 0.9**steps), np.sqrt(self.second / (1 - 0.99**steps))
        move = -fall * rates * mean / (spread + 1e-15)
        odds = k / (1 - k) * np.exp(move[0])
        moved = self.values * np.exp(move)
        moved[0], moved[1] = odds / (1 + odds), self.values[1] + move[1]
        self.values = np.clip(moved, LOWEST, HIGHEST)

    def normals(self) -> Floats:
        """[N, 3] unit normals."""
        normals = self.material[:, 3:]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.maximum(length, np.float32(1e-12)), np.float32)

    def select(self, source: npt.NDArray[np.int64], fresh: Bools) -> None:
        """Rows follow those of the packed scene (see `Trainer.replace`)."""
        self.material = np.ascontiguousarray(self.material[source])
        self.adam.select(source, fresh)

    def light(self, scale: float) -> Light:
        """What was fitted, with lengths in units of 1 / `scale`."""
        k, p, m1, s1, m2, s2 = (float(value) for value in self.values)
        return Light(
            self.material[:, :3].copy(), self.normals(), diffuse_share=k, falloff=p,
            distance=scale, widths=(m1, m2), strengths=(s1, s2), gamma=self.settings.light_gamma,
        )  # fmt: skip


def initial_material(
    cloud: Cloud,
    surface: Array,
    images: Sequence[Floats],
    masks: Sequence[Bools],
    cameras: Sequence[Camera],
    settings: FitSettings,
) -> Floats:
    """Albedo and normal to start from: what the views show, less the light.

    Each view that sees a point tells its colour; where the model expects a highlight, or the pixel
    is nearly white, it hardly counts.

    Args:
        cloud: the points that become Gaussians.
        surface: [M, 3] all points: what hides what.
        images: [H, W, 3] of the views; masks: [H, W] where they may be used.
        cameras: theirs, in the frame of the fit.
        settings: the light to start from.

    Returns:
        [N, 6] float32.
    """
    s = settings
    count = len(cloud)
    middle = np.mean([camera.centre for camera in cameras], 0)
    towards = middle - cloud.positions
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    known = np.abs(cloud.normals).sum(1) > 0
    normals = np.where(known[:, None], cloud.normals, towards)
    total, mass = np.zeros((count, 3)), np.zeros(count)
    for image, mask, camera in zip(images, masks, cameras, strict=True):
        pixels, depth = camera.project(cloud.positions)
        column = np.clip(np.floor(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
        row = np.clip(np.floor(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        front = point_depth(surface, camera, camera.width, camera.height)[row, column]
        seen = inside & (depth > 0) & mask[row, column]
        seen &= (front > 0) & (np.abs(depth - front) < SAME_SURFACE * depth)
        colour = np.asarray(image[row, column], np.float64)
        ray = camera.centre - cloud.positions
        distance = np.linalg.norm(ray, axis=1)
        cosine = (normals * ray).sum(1) / distance
        lit = matte(cosine, distance, s)
        # half as narrow as the lobe that is expected: normals are not exact
        highlight = np.exp(0.5 * s.light_widths[0] * (cosine - 1))
        weight = seen * np.clip(cosine, 0, 1) * np.exp(-4 * highlight)
        weight = weight * np.clip((1.02 - colour.max(1)) / 0.2, 0.02, 1)
        total += weight[:, None] * colour**s.light_gamma / lit[:, None]
        mass += weight
    typical = facing(cloud.positions, normals, cameras)
    away = np.linalg.norm(middle - cloud.positions, axis=1)
    plain = cloud.colors**s.light_gamma / matte(typical, away, s)[:, None]
    # a thousandth of a good sight: the cloud's own colour where no view tells better
    radiance = (total + 1e-3 * plain) / (mass + 1e-3)[:, None]
    albedo = np.clip(radiance, 1e-6, 4) ** (1 / s.light_gamma)
    return np.ascontiguousarray(np.concatenate([albedo, normals], 1), np.float32)


def matte(cosine: Array, distance: Array, s: FitSettings) -> Array:
    """[N] light on a surface without highlights, held off 0."""
    diffuse = 1 - s.light_diffuse + s.light_diffuse * np.clip(cosine, 0, 1)
    return np.maximum(diffuse / distance**s.light_falloff, 0.15)
