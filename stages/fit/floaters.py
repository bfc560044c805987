"""What a finished fit does without: Gaussians that no view needs, and those before the lens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from stages.splatting.rasterizer import Rendering, Viewpoint

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]


def contribution(rendering: Rendering, mask: Floats) -> tuple[Floats, Floats]:
    """Sum over pixels of each Gaussian's blending weight: the area that it colours, in pixels.

    Args:
        rendering: of one view.
        mask: [H, W] float32, 1 where the view's photograph may be used.

    Returns:
        [N] over the whole image, and [N] inside the mask only.
    """
    per_pixel = np.zeros_like(rendering.planes)
    per_pixel[0] = 1
    per_pixel[1] = mask
    gradients = rendering.backward(per_pixel, np.zeros_like(rendering.transmittance))
    areas = gradients.features
    return np.ascontiguousarray(areas[:, 0]), np.ascontiguousarray(areas[:, 1])


def before_lens(packed: Floats, viewpoints: Sequence[Viewpoint], nearest: Sequence[float]) -> Bools:
    """[N] Gaussians that lie inside a view's frustum and nearer than `nearest` of that view."""
    close = np.zeros(len(packed), bool)
    means = packed[:, :3]
    for viewpoint, limit in zip(viewpoints, nearest, strict=True):
        local = means @ viewpoint.pose[:, :3].T + viewpoint.pose[:, 3]
        depth = np.maximum(local[:, 2], np.float32(1e-6))
        fx, fy, cx, cy = viewpoint.intrinsics
        u, v = fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy
        inside = (u >= 0) & (u < viewpoint.width) & (v >= 0) & (v < viewpoint.height)
        close |= (local[:, 2] > 0) & (local[:, 2] < limit) & inside
    return close
