"""A light beside the lens: the colour of Gaussians in one view from albedo, normal and one flash.

An intra-oral camera's flash moves with it, so shading and highlights move over the tissue from view
to view. With the light at the camera's centre C everything depends on one cosine c = n . v, where v
points from the Gaussian to C, and on the distance r (Blinn-Phong's half vector is v itself):

    radiance = fall * (albedo^gamma * (1 - k + k max(c, 0)) + sum_j s_j exp(m_j (c - 1)))
    fall = (r0 / r)^p,    colour = radiance^(1 / gamma)

Albedo and normal belong to each Gaussian; k, p, and the two lobes' strengths s and widths m belong
to the scene. `shade` writes the colours where the rasterizer reads constant harmonics (degree 0),
`shade_backward` takes the rasterizer's gradients to all inputs. Lobes this narrow can't be
expressed in spherical harmonics, which is why this exists.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians, Light
from stages.splatting.kernels.projection import CHUNK
from stages.splatting.kernels.shading import (
    GLOBALS,
    LIT_COLUMNS,
    MATERIAL_COLUMNS,
    shade_backward_kernel,
    shade_kernel,
    shade_lanes,
)
from stages.splatting.rasterizer import pack
from stages.splatting.threads import KERNELS

__all__ = ["LitScene", "ShadeGradients", "coefficients", "shade", "shade_backward"]

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]


def coefficients(light: Light) -> Floats:
    """The scene's share of a light as the kernels take it.

    Returns:
        [8] float32: k, p, m and s of the narrow lobe, m and s of the broad lobe, r0, gamma.
    """
    (m1, m2), (s1, s2) = light.widths, light.strengths
    values = [light.diffuse_share, light.falloff, m1, s1, m2, s2, light.distance, light.gamma]
    return np.array(values, np.float32)


@dataclass(frozen=True)
class ShadeGradients:
    """Attributes:
    material: [N, 6] of albedo and normal.
    light: [6] float64 by k, p, m and s of the narrow lobe, m and s of the broad one.
    pose: [6] float64 of a twist applied to cam_from_world from the left; its rotation is 0.
    """

    material: Floats
    light: Array
    pose: Array


def shade(packed: Floats, material: Floats, centre: Floats, light: Floats) -> Floats:
    """Write the colours of a view into `packed`, to be rasterized with degree 0.

    Args:
        packed: [N, 14] float32 contiguous scene; columns 11:14 are overwritten.
        material: [N, 6] float32 contiguous: albedo (before the light, sRGB-like) and normal.
        centre: [3] float32 centre of camera and light.
        light: [8] float32, see `coefficients`.

    Returns:
        [N, 3] radiance, for `shade_backward`.

    Raises:
        ValueError: an array has the wrong shape.
    """
    if packed.shape[1:] != (LIT_COLUMNS,) or material.shape != (len(packed), MATERIAL_COLUMNS):
        raise ValueError(
            f"packed must be [N, {LIT_COLUMNS}] and material [N, {MATERIAL_COLUMNS}], got "
            f"{packed.shape} and {material.shape}"
        )
    radiance = np.empty((len(packed), 3), packed.dtype)
    kernel = shade_lanes if packed.dtype == np.float32 else shade_kernel
    with KERNELS:
        kernel(packed, material, centre, light, radiance)
    return radiance


def shade_backward(
    packed: Floats, material: Floats, centre: Floats, pose: Floats, light: Floats,
    radiance: Floats, gradient: Floats,
) -> ShadeGradients:  # fmt: skip
    """Gradients of `shade`; adds to `gradient` [N, 14] what reaches the positions (columns 0:3).

    Args:
        packed, material, centre, light, radiance: as `shade` had, left and returned them.
        pose: [3, 4] float32 cam_from_world.
        gradient: [N, 14] what the rasterizer's backward pass gave.
    """
    d_material = np.empty_like(material)
    parts = np.empty((-(-len(packed) // CHUNK), GLOBALS + 3), packed.dtype)
    with KERNELS:
        shade_backward_kernel(
            packed, material, centre, pose, light, radiance, gradient, d_material, parts
        )
    sums = parts.sum(0, dtype=np.float64)
    return ShadeGradients(d_material, sums[:GLOBALS], np.concatenate([sums[GLOBALS:], np.zeros(3)]))


class LitScene:
    """Gaussians with a light, for one camera after another, from any thread.

    Args:
        gaussians: the scene.

    Raises:
        ValueError: the Gaussians have no light.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        light = gaussians.light
        if light is None:
            raise ValueError("these Gaussians have no light; render their spherical harmonics")
        self._packed = pack(
            gaussians.means, gaussians.quats_wxyz, gaussians.log_scales, gaussians.logit_opacities,
            np.zeros((len(gaussians), 1, 3), np.float32),
        )  # fmt: skip
        self._material = np.ascontiguousarray(
            np.concatenate([light.albedo, light.normals], 1), np.float32
        )
        self._light = coefficients(light)
        self._own = threading.local()

    def seen_from(self, centre: npt.NDArray[np.floating]) -> Floats:
        """[N, 14] packed, of degree 0, as a camera at `centre` [3] sees them.

        The next call in the same thread writes it anew.
        """
        if not hasattr(self._own, "packed"):
            self._own.packed = self._packed.copy()
        packed: Floats = self._own.packed
        shade(packed, self._material, np.asarray(centre, np.float32), self._light)
        return packed
