"""The terms of the loss beside colour: depth of the input points, and optical flow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stages.splatting.rasterizer import Rendering

Floats = npt.NDArray[np.float32]

#: where less light than this is stopped, depth and flow are of what lies behind as well
MIN_ALPHA = 0.5


def depth_loss(
    rendering: Rendering, depth: Floats, weight: float, d_plane: Floats, d_transmittance: Floats
) -> float:
    """Mean |depth / alpha - target| where points are seen; adds `weight` times its gradient."""
    alpha = np.maximum(1 - rendering.transmittance, np.float32(1e-3))
    seen = (depth > 0) & (alpha > MIN_ALPHA)
    count = max(int(seen.sum()), 1)
    mean = rendering.planes[3] / alpha
    error = (mean - depth) * seen
    by_mean = np.sign(error) * np.float32(weight / count)
    d_plane += by_mean / alpha
    d_transmittance += by_mean * mean / alpha
    return float(np.abs(error).sum(dtype=np.float64)) / count


def flow_loss(
    planes: Floats, transmittance: Floats, flow: Floats, mask: Floats, weight: float,
    d_planes: Floats, d_transmittance: Floats,
) -> float:  # fmt: skip
    """Mean length of the flow error in px over the mask; adds `weight` times its gradient.

    Composited flow is divided by alpha: the weights of GaussianFlow are normalised. Gradients reach
    the weights as well.
    """
    alpha = np.maximum(1 - transmittance, np.float32(1e-3))
    trusted = (mask > 0) & (alpha > MIN_ALPHA)
    count = max(int(trusted.sum()), 1)
    mean = planes / alpha
    error = (mean - flow) * trusted
    length = np.sqrt((error**2).sum(0) + np.float32(1e-8))
    by_mean = error / length * np.float32(weight / count)
    d_planes += by_mean / alpha
    d_transmittance += (by_mean * mean).sum(0) / alpha
    return float((length * trusted).sum(dtype=np.float64)) / count


def interpolate(start: float, end: float, done: float) -> float:
    """Exponential from `start` (done = 0) to `end` (done = 1); linear where one of them is 0."""
    if start <= 0 or end <= 0:
        return start + (end - start) * done
    return float(start * (end / start) ** done)


def logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))
