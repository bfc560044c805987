"""Gaussians in an order in which neighbours in space are neighbours in the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians

#: Bits a coordinate of a Morton code.
BITS = 10


def morton_order(points: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
    """[N] indices of finite points [N, 3] along a Z-shaped curve (Morton 1966) through cubes that
    fill the box of the middle 98 %.

    Ties stay in their order.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    most = (1 << BITS) - 1
    cells = np.clip((points - low) / np.maximum(high - low, 1e-30).max() * most, 0, most)
    cells = cells.astype(np.uint64)
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
