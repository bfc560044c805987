"""Gaussians in an order in which neighbours in space are neighbours in the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians

#: Bits a coordinate of a Morton code.
BITS = 10


def morton_order(points: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
    """[N] indices of finite points [N, 3] along a Morton curve through the box of the middle 98 %.

    Ties stay in their order.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.percentile(points, [1, 99], axis=0)
    share = (points - low) / np.maximum(high - low, 1e-30)
    cells = np.clip(share * (1 << BITS), 0, (1 << BITS) - 1).astype(np.uint64)
    return order_of_cells(cells)


def order_of_cells(cells: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """[N] indices of cells [N, 3] of a grid of `BITS` bits an axis along a Morton curve."""
    code = np.zeros(len(cells), np.uint64)
    for bit in range(BITS):
        for axis in range(3):
            one = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= one << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def taken(gaussians: Gaussians, index: npt.NDArray[np.integer]) -> Gaussians:
    """The Gaussians that an index array names, in its order, without their light."""
    return replace(
        gaussians, means=gaussians.means[index], quats_wxyz=gaussians.quats_wxyz[index],
        log_scales=gaussians.log_scales[index], logit_opacities=gaussians.logit_opacities[index],
        sh=gaussians.sh[index], light=None,
    )  # fmt: skip
