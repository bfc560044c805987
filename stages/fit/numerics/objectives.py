"""The terms of the loss beside colour: depth of the input points, and optical flow."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from pipeline.kernels import kernel
from stages.fit.arrays import Array, Floats
from stages.splatting.rasterizer import Rendering
from stages.splatting.threads import KERNELS

F = np.float32

#: where less light than this is stopped, depth and flow are of what lies behind as well
MIN_ALPHA = F(0.5)
#: px^2 added to the square of a length, so that it has a gradient at 0
SMOOTH = F(1e-8)


@kernel(parallel=True)
def _compare_depth(  # type: ignore[no-untyped-def]
    plane: Floats, transmittance: Floats, depth: Floats, sums: Array
):
    """Number of pixels and sum of the absolute errors into `sums` [H, 2], row by row."""
    height, width = depth.shape
    for y in prange(height):
        count, total = 0, 0.0
        for x in range(width):
            alpha = max(F(1) - transmittance[y, x], F(1e-3))
            if depth[y, x] > F(0) and alpha > MIN_ALPHA:
                count += 1
                total += abs(plane[y, x] / alpha - depth[y, x])
        sums[y, 0] = count
        sums[y, 1] = total


@kernel(parallel=True)
def _pull_to_depth(  # type: ignore[no-untyped-def]
    plane: Floats, transmittance: Floats, depth: Floats, weight: np.float32, d_plane: Floats,
    d_transmittance: Floats,
):  # fmt: skip
    """Add `weight` times the gradient of the sum of the absolute errors."""
    height, width = depth.shape
    for y in prange(height):
        for x in range(width):
            alpha = max(F(1) - transmittance[y, x], F(1e-3))
            if depth[y, x] > F(0) and alpha > MIN_ALPHA:
                mean = plane[y, x] / alpha
                by_mean = F(np.sign(mean - depth[y, x])) * weight
                d_plane[y, x] += by_mean / alpha
                d_transmittance[y, x] += by_mean * mean / alpha


def depth_loss(
    rendering: Rendering, depth: Floats, weight: float, d_plane: Floats, d_transmittance: Floats
) -> float:
    """Mean |depth / alpha - target| where points are seen; adds `weight` times its gradient."""
    given = (rendering.planes[3], rendering.transmittance, depth)
    sums = np.empty((len(depth), 2))
    with KERNELS:
        _compare_depth(*given, sums)
        count, total = sums.sum(0)
        count = max(float(count), 1.0)
        _pull_to_depth(*given, F(weight / count), d_plane, d_transmittance)
    return float(total) / count


@kernel(parallel=True)
def _compare_flow(  # type: ignore[no-untyped-def]
    planes: Floats, transmittance: Floats, flow: Floats, mask: Floats, sums: Array
):
    """Number of pixels and sum of the lengths of the errors into `sums` [H, 2], row by row."""
    height, width = mask.shape
    for y in prange(height):
        count, total = 0, 0.0
        for x in range(width):
            alpha = max(F(1) - transmittance[y, x], F(1e-3))
            if mask[y, x] > F(0) and alpha > MIN_ALPHA:
                du = planes[0, y, x] / alpha - flow[0, y, x]
                dv = planes[1, y, x] / alpha - flow[1, y, x]
                count += 1
                total += math.sqrt(du * du + dv * dv + SMOOTH)
        sums[y, 0] = count
        sums[y, 1] = total


@kernel(parallel=True)
def _pull_to_flow(  # type: ignore[no-untyped-def]
    planes: Floats, transmittance: Floats, flow: Floats, mask: Floats, weight: np.float32,
    d_planes: Floats, d_transmittance: Floats,
):  # fmt: skip
    """Add `weight` times the gradient of the sum of the lengths of the errors."""
    height, width = mask.shape
    for y in prange(height):
        for x in range(width):
            alpha = max(F(1) - transmittance[y, x], F(1e-3))
            if mask[y, x] > F(0) and alpha > MIN_ALPHA:
                inverse = F(1) / alpha
                u, v = planes[0, y, x] * inverse, planes[1, y, x] * inverse
                du, dv = u - flow[0, y, x], v - flow[1, y, x]
                scale = weight * inverse / math.sqrt(du * du + dv * dv + SMOOTH)
                d_planes[0, y, x] += du * scale
                d_planes[1, y, x] += dv * scale
                d_transmittance[y, x] += (du * u + dv * v) * scale


def flow_loss(
    planes: Floats, transmittance: Floats, flow: Floats, mask: Floats, weight: float,
    d_planes: Floats, d_transmittance: Floats,
) -> float:  # fmt: skip
    """Mean length of the flow error in px over the mask; adds `weight` times its gradient.

    Composited flow is divided by alpha: the weights of GaussianFlow are normalised. Gradients reach
    the weights as well.
    """
    given = (planes, transmittance, flow, mask)
    sums = np.empty((len(mask), 2))
    with KERNELS:
        _compare_flow(*given, sums)
        count, total = sums.sum(0)
        count = max(float(count), 1.0)
        _pull_to_flow(*given, F(weight / count), d_planes, d_transmittance)
    return float(total) / count
