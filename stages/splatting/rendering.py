"""Pictures of finished Gaussians, for export and evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from stages.splatting.harmonics import harmonics
from stages.splatting.kernels.features import HARMONICS
from stages.splatting.light import lit_scene
from stages.splatting.rasterizer import Viewpoint, pack, rasterize, use_threads

Floats = npt.NDArray[np.float32]

#: near plane as a fraction of the median depth of what lies in front of the camera
NEAR_FRACTION = 0.02
#: colour = .5 + this * constant of the harmonics
CONSTANT_HARMONIC = 0.28209479177387814


@dataclass(frozen=True)
class RenderedView:
    """Attributes:
    image: [H, W, 3] float32 sRGB, composited over the background (not clipped above 1).
    alpha: [H, W] float32 in 0..1.
    depth: [H, W] float32, blended z of the Gaussians divided by alpha; 0 where alpha is 0.
    """

    image: Floats
    alpha: Floats
    depth: Floats


def _as_seen(gaussians: Gaussians, camera: Camera) -> tuple[Floats, int]:
    """The packed scene, and the degree of its harmonics."""
    if gaussians.light is not None:
        return lit_scene(gaussians, camera.centre), 0
    # trailing harmonics that are zero everywhere cost time and change nothing
    degree = 3
    while degree > 0 and not gaussians.sh[:, degree * degree : (degree + 1) ** 2].any():
        degree -= 1
    packed = pack(
        gaussians.means, gaussians.quats_wxyz, gaussians.log_scales, gaussians.logit_opacities,
        gaussians.sh[:, : (degree + 1) ** 2],
    )  # fmt: skip
    return packed, degree


def seen_colors(gaussians: Gaussians, camera: Camera) -> Floats:
    """[N, 3] the colour of each Gaussian as a camera sees it, not clipped above 1."""
    if gaussians.light is not None:
        lit = lit_scene(gaussians, camera.centre)[:, HARMONICS : HARMONICS + 3]
        return np.asarray(np.maximum(0.5 + CONSTANT_HARMONIC * lit, 0), np.float32)
    rays = gaussians.means - camera.centre
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-30)
    colors = 0.5 + np.einsum("nk,nkc->nc", harmonics(rays).astype(np.float32), gaussians.sh)
    return np.asarray(np.maximum(colors, 0), np.float32)


def contributions(gaussians: Gaussians, camera: Camera) -> Floats:
    """[N] how much each Gaussian adds to a camera's picture: the sum of its weights, in pixels."""
    packed = pack(
        gaussians.means, gaussians.quats_wxyz, gaussians.log_scales, gaussians.logit_opacities,
        np.zeros((len(gaussians), 1, 3), np.float32),
    )  # fmt: skip
    size = (camera.height, camera.width)
    seen = rasterize(
        packed, Viewpoint.of(camera), degree=None, near=near_plane(gaussians, camera),
        features=np.ones((len(gaussians), 1), np.float32),
    )  # fmt: skip
    # The gradient of the picture's sum by a colour is the sum of that Gaussian's weights.
    gradients = seen.backward(np.ones((1, *size), np.float32), np.zeros(size, np.float32))
    return gradients.features[:, 0]


def near_plane(gaussians: Gaussians, camera: Camera) -> float:
    """2 % of the median depth in front of a camera."""
    z = gaussians.means @ camera.rotation[2].astype(np.float32) + np.float32(camera.translation[2])
    ahead = z[z > 0]
    return NEAR_FRACTION * float(np.median(ahead)) if len(ahead) else 1e-6


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | None = None,
    threads: int | None = None,
    near: float | None = None,
) -> RenderedView:
    """Render Gaussians as a camera sees them, with the light beside it where they have one.

    Args:
        gaussians: the scene.
        camera: with the size of the picture.
        background: sRGB colour behind everything; None: the scene's own.
        threads: how many to use (None: all); never changes the result.
        near: near plane in world units; None: 2 % of the median depth in front of the camera.
    """
    use_threads(threads)
    packed, degree = _as_seen(gaussians, camera)
    if near is None:
        near = near_plane(gaussians, camera)
    result = rasterize(packed, Viewpoint.of(camera), degree=degree, near=near, depth=True)
    alpha = 1 - result.transmittance
    behind = np.asarray(gaussians.background if background is None else background, np.float32)
    image = result.planes[:3].transpose(1, 2, 0) + result.transmittance[..., None] * behind
    depth = np.where(alpha > 0, result.planes[3] / np.maximum(alpha, 1e-8), 0)
    return RenderedView(
        np.ascontiguousarray(image, np.float32), alpha, np.asarray(depth, np.float32)
    )
