"""Gaussians held to the surface that they start on, in proportion to how sure it is.

From three photographs a fit can explain every pixel with needles and gaps that only the three
cameras don't see. Where the surface is known, Gaussians start as flat discs along it, and what
takes them off it is drawn back after every step. The surface itself may bend as a whole (`warp`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from stages.fit.numerics.warp import turned
from stages.splatting.threads import KERNELS

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
F = np.float32


def along_normals(packed: Floats, normals: Array, flatness: float) -> None:
    """Turn Gaussians so that their third axis is the normal, and flatten them along it.

    Args:
        packed: [N, D], changed in place.
        normals: [N, 3] unit, 0 where unknown (those stay as they are).
        flatness: standard deviation along the normal, relative to that across it.
    """
    known = np.abs(normals).sum(1) > 0
    unturned = np.tile(np.array([1, 0, 0, 0], np.float32), (int(known.sum()), 1))
    ahead = np.tile(np.array([0.0, 0.0, 1.0]), (len(unturned), 1))
    packed[known, 3:7] = turned(unturned, ahead, normals[known])
    packed[known, 9] += np.float32(np.log(flatness))


@njit(parallel=True, cache=True, error_model="numpy")
def _pull(packed: Floats, anchor: Floats, turn: Floats):  # type: ignore[no-untyped-def]
    for i in prange(len(packed)):
        firmness, widest = anchor[i, 7], anchor[i, 8]
        off = F(0)
        for k in range(3):
            off += (packed[i, k] - anchor[i, k]) * anchor[i, 3 + k]
        for k in range(3):
            packed[i, k] -= off * firmness * anchor[i, 3 + k]
        for k in range(4):
            packed[i, 3 + k] += firmness * (turn[i, k] - packed[i, 3 + k])
        packed[i, 9] += firmness * (anchor[i, 6] - packed[i, 9])
        for k in range(7, 10):
            packed[i, k] = min(packed[i, k], widest)


def pull(packed: Floats, anchor: Floats, turn: Floats) -> None:
    """Draw Gaussians [N, D] back onto their surface: position, turn, thickness; bound the width.

    Args:
        anchor: [N, 9] position, normal (0: free), log of the thickness, firmness 0..1, log of the
            largest width.
        turn: [N, 4] quaternions to be kept.
    """
    with KERNELS:
        _pull(packed, anchor, turn)
