"""The compact form in which the viewer page carries Gaussians: whole texels, ready for the GPU.

Each splat takes `texels(degree)` texels of four 32-bit words (little-endian):

====== ==== ====================================================================================
texel  word content
====== ==== ====================================================================================
0      0-2  mean x, y, z: float32 (far backdrop and near teeth in one file need the range)
0      3    rotation: quaternion wxyz with the largest component left out (made positive): bits
            30-31 which one it is, 0-9, 10-19, 20-29 the others in order, [-1/sqrt 2, 1/sqrt 2]
1      0    halfs: log scale x, y
1      1    halfs: log scale z, opacity (0..1)
1      2-3  halfs: f_dc r, g, b, and the first number of the rest
2...        halfs: the rest of the spherical harmonics, [coefficient][channel], after the first
====== ==== ====================================================================================

That is 32, 48, 80 or 128 bytes a splat for degree 0, 1, 2, 3.

Where a light beside the lens lit the scene, f_dc holds the albedo (as .5 + C0 f_dc), the rest the
normal, in the texels of degree 1; the shader does what `stages.splatting.light` does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians

#: Splats in a row of the texture; times 8 texels it is the 4096 that every WebGL2 device can do.
PER_ROW = 512
#: Colour = .5 + this * f_dc.
CONSTANT_HARMONIC = 0.28209479177387814


def coefficients(degree: int) -> int:
    """Number of spherical-harmonics coefficients after the constant."""
    return (degree + 1) ** 2 - 1


def texels(degree: int) -> int:
    """Texels (16 bytes) that a splat takes."""
    halfs_beyond = max(0, 3 * coefficients(degree) - 1)
    return 2 + -(-halfs_beyond // 8)


def used_degree(gaussians: Gaussians) -> int:
    """Highest spherical-harmonics degree with a coefficient that is not zero."""
    return max(
        (d for d in (1, 2, 3) if np.any(gaussians.sh[:, d * d : (d + 1) ** 2])),
        default=0,
    )


def visible(gaussians: Gaussians, alpha_min: float) -> npt.NDArray[np.bool_]:
    """[N] bool: finite, and opaque enough to be drawn at all."""
    finite = np.isfinite(gaussians.means).all(1) & np.isfinite(gaussians.log_scales).all(1)
    finite &= np.isfinite(gaussians.quats_wxyz).all(1) & np.isfinite(gaussians.sh).all((1, 2))
    return finite & (opacities(gaussians) >= alpha_min)


def opacities(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """[N] float64 in 0..1."""
    return 1.0 / (1.0 + np.exp(-gaussians.logit_opacities.astype(np.float64)))


def pack_quaternions(quats_wxyz: npt.NDArray[np.floating]) -> npt.NDArray[np.uint32]:
    """[N, 4] quaternions -> [N] uint32 (2 + 3 x 10 bits, see the module)."""
    quats = np.asarray(quats_wxyz, np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]  # [N, 3]
    share = (quats[rows[:, None], others] * np.sqrt(2) + 1) / 2
    levels = np.clip(np.rint(share * 1023), 0, 1023).astype(np.uint32)
    packed = levels[:, 0] | levels[:, 1] << np.uint32(10) | levels[:, 2] << np.uint32(20)
    return packed | largest.astype(np.uint32) << np.uint32(30)


def with_material(gaussians: Gaussians) -> Gaussians:
    """Albedo and normal in the place of the harmonics, for Gaussians with a light."""
    light = gaussians.light
    assert light is not None
    sh = np.zeros_like(gaussians.sh)
    sh[:, 0] = (light.albedo - 0.5) / CONSTANT_HARMONIC
    sh[:, 1] = light.normals / np.linalg.norm(light.normals, axis=1, keepdims=True)
    return replace(gaussians, sh=sh)


def pack(gaussians: Gaussians, degree: int) -> npt.NDArray[np.uint32]:
    """Pack Gaussians for the viewer.

    Args:
        gaussians: N Gaussians, all finite.
        degree: spherical-harmonics degree to keep, 0..3.

    Returns:
        [N, texels(degree) * 4] little-endian uint32.
    """
    count = len(gaussians)
    rest = gaussians.sh[:, 1 : 1 + coefficients(degree)].reshape(count, -1)
    halfs = np.zeros((count, 8 * (texels(degree) - 1)), "<f2")
    limit = float(np.finfo(np.float16).max)
    halfs[:, :3] = np.clip(gaussians.log_scales, -30, 30)
    halfs[:, 3] = opacities(gaussians)
    halfs[:, 4:7] = np.clip(gaussians.sh[:, 0], -limit, limit)
    halfs[:, 7 : 7 + rest.shape[1]] = np.clip(rest, -limit, limit)
    words = np.empty((count, 4 * texels(degree)), "<u4")
    words[:, :3] = np.ascontiguousarray(gaussians.means, "<f4").view("<u4")
    words[:, 3] = pack_quaternions(gaussians.quats_wxyz)
    words[:, 4:] = halfs.view("<u4")
    return words
