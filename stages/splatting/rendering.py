"""Pictures of finished Gaussians, for export and evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from pipeline.kernels import kernel
from stages.splatting.harmonics import harmonics
from stages.splatting.kernels.projection import HARMONICS
from stages.splatting.light import LitScene
from stages.splatting.rasterizer import Rendering, Viewpoint, pack, rasterize, use_threads

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


def used_degree(gaussians: Gaussians) -> int:
    """Highest spherical-harmonics degree with a coefficient that is not zero."""
    return max(
        (d for d in (1, 2, 3) if np.any(gaussians.sh[:, d * d : (d + 1) ** 2])),
        default=0,
    )


class Painter:
    """Draws the same Gaussians as one camera after another sees them, from any thread.

    Args:
        gaussians: the scene, with the light beside the camera where it has one.
        background: sRGB colour behind everything; None: the scene's own.
        threads: how many to use (None: all); never changes the result.
    """

    def __init__(
        self, gaussians: Gaussians, background: Sequence[float] | None = None,
        threads: int | None = None,
    ) -> None:  # fmt: skip
        self.background = np.array(
            gaussians.background if background is None else background, np.float32
        )
        self._gaussians, self._threads = gaussians, threads
        if gaussians.light is not None:
            self._degree, self._lit = 0, LitScene(gaussians)
            return
        # trailing harmonics that are zero everywhere cost time and change nothing
        self._degree = used_degree(gaussians)
        self._packed = pack(
            gaussians.means, gaussians.quats_wxyz, gaussians.log_scales, gaussians.logit_opacities,
            gaussians.sh[:, : (self._degree + 1) ** 2],
        )  # fmt: skip

    def composited(self, camera: Camera, near: float, depth: bool) -> Rendering:
        """What lies before the background: three planes of colour, and one of `depth`."""
        use_threads(self._threads)
        lit = self._gaussians.light is not None
        packed = self._lit.seen_from(camera.centre) if lit else self._packed
        return rasterize(packed, Viewpoint.of(camera), degree=self._degree, near=near, depth=depth)

    def __call__(self, camera: Camera, near: float | None = None) -> RenderedView:
        """See `render`."""
        if near is None:
            near = near_plane(self._gaussians, camera)
        drawn = self.composited(camera, near, depth=True)
        size = (camera.height, camera.width)
        image, depth = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
        _put_before(drawn.planes, drawn.transmittance, self.background, image, depth)
        return RenderedView(image, 1 - drawn.transmittance, depth)


@kernel(
    "void(float32[:,:,::1], float32[:,::1], float32[::1], float32[:,:,::1], float32[:,::1])",
    nogil=True,
)
def _put_before(  # type: ignore[no-untyped-def]
    planes, transmittance, background, image, depth,
):  # fmt: skip
    """Image and depth of `RenderedView` from what was composited: planes [4, H, W]."""
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            left = transmittance[y, x]
            for c in range(3):
                image[y, x, c] = planes[c, y, x] + left * background[c]
            alpha = np.float32(1) - left
            divisor = max(alpha, np.float32(1e-8))
            depth[y, x] = planes[3, y, x] / divisor if alpha > 0 else np.float32(0)


def seen_colors(gaussians: Gaussians, camera: Camera) -> Floats:
    """[N, 3] the colour of each Gaussian as a camera sees it, not clipped above 1."""
    if gaussians.light is not None:
        lit = LitScene(gaussians).seen_from(camera.centre)[:, HARMONICS : HARMONICS + 3]
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

    `Painter` does so for one camera after another.

    Args:
        gaussians: the scene.
        camera: with the size of the picture.
        background: sRGB colour behind everything; None: the scene's own.
        threads: how many to use (None: all); never changes the result.
        near: near plane in world units; None: 2 % of the median depth in front of the camera.
    """
    return Painter(gaussians, background, threads)(camera, near)
