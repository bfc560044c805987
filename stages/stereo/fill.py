"""Depth where stereo knows nothing: smooth completion that errs to the far side.

Holes inside a surface are bridged; a backdrop, which the image separates from the surface by an
edge, falls back behind everything that is known.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange
from scipy import ndimage

from pipeline.kernels import kernel

Array = npt.NDArray[np.float32]

#: Grey difference that counts as an edge.
_EDGE = np.float32(0.04)
#: Gauss-Seidel sweeps per level.
_SWEEPS = 24


@kernel(parallel=True)
def _relax(value, data, weight, right, down, pull, far, sweeps):  # type: ignore[no-untyped-def]
    """Red-black Gauss-Seidel on the screened membrane energy of `complete`."""
    height, width = value.shape
    for sweep in range(2 * sweeps):
        for y in prange(height):
            for x in range((y + sweep) & 1, width, 2):
                total = weight[y, x] * data[y, x] + pull * far
                mass = weight[y, x] + pull
                if x > 0:
                    total += right[y, x - 1] * value[y, x - 1]
                    mass += right[y, x - 1]
                if x < width - 1:
                    total += right[y, x] * value[y, x + 1]
                    mass += right[y, x]
                if y > 0:
                    total += down[y - 1, x] * value[y - 1, x]
                    mass += down[y - 1, x]
                if y < height - 1:
                    total += down[y, x] * value[y + 1, x]
                    mass += down[y, x]
                value[y, x] = total / mass


def _halve(array: Array) -> Array:
    """Mean over 2x2 blocks, the last row and column repeated where the size is odd."""
    padded = np.pad(array, [(0, array.shape[0] & 1), (0, array.shape[1] & 1)], mode="edge")
    return (
        padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]
    ) / np.float32(4)


def complete(
    inverse_depth: Array,
    weight: Array,
    gray: Array,
    far: float,
    reach_px: float = 80.0,
) -> Array:
    """Complete an inverse depth map.

    Minimises sum w (v - d)^2 + sum g (v_p - v_q)^2 + (v - far)^2 / reach^2 over neighbouring
    pixels p, q with g = exp(-|I_p - I_q| / `_EDGE`) + 0.002, from coarse to fine.

    Args:
        inverse_depth: [H, W] float32.
        weight: [H, W] float32 trust in it; 0 where it is unknown.
        gray: [H, W] float32 in 0..1, whose edges stop the smoothing.
        far: inverse depth that everything is drawn to.
        reach_px: how far known depth reaches into a hole without edges, in pixels.

    Returns:
        [H, W] float32 inverse depth everywhere.
    """
    levels = [(inverse_depth, weight, gray)]
    while min(levels[-1][0].shape) > 12:
        data, trust, image = levels[-1]
        mass = _halve(trust)
        mean = _halve(trust * data) / np.maximum(mass, 1e-12)
        levels.append((mean.astype(np.float32), (4 * mass).astype(np.float32), _halve(image)))
    value = np.full(levels[-1][0].shape, far, np.float32)
    for level in range(len(levels) - 1, -1, -1):
        data, trust, image = levels[level]
        if level < len(levels) - 1:
            value = value.repeat(2, 0).repeat(2, 1)[: data.shape[0], : data.shape[1]]
        value = np.ascontiguousarray(value, np.float32)
        right, down = np.zeros_like(data), np.zeros_like(data)
        right[:, :-1] = np.exp(-np.abs(np.diff(image, axis=1)) / _EDGE) + 0.002
        down[:-1] = np.exp(-np.abs(np.diff(image, axis=0)) / _EDGE) + 0.002
        pull = np.float32((2.0**level / reach_px) ** 2)
        _relax(value, data, trust, right, down, pull, np.float32(far), _SWEEPS)
    return value


def continued(guess: Array, known: Array, gray: Array, most: float, reach_px: float) -> Array:
    """A guessed depth, moved so that it goes on from what is known beside it.

    Where both are, they differ; the guess is off by as much next to that, and by ever less further
    away (see `complete`).

    Args:
        guess: [H, W] float32 z-depth, 0 where there is none.
        known: [H, W] float32 z-depth, 0 where unknown.
        gray: [H, W] float32 in 0..1, whose edges end what goes on.
        most: where both differ by more than this depth, one of them is of something else.
        reach_px: how far it goes on where there are no edges, in pixels.

    Returns:
        [H, W] float32 z-depth, 0 where `guess` has none.
    """
    there = guess > 0
    both = there & (known > 0) & (np.abs(known - guess) < most)
    inverse = np.where(there, 1 / np.where(there, guess, 1), 0)
    off = np.where(both, 1 / np.where(both, known, 1) - inverse, 0)
    off = complete(off.astype(np.float32), both.astype(np.float32), gray, 0.0, reach_px)
    return np.where(there, 1 / np.where(there, inverse + off, 1), 0).astype(np.float32)


def distance_to(known: npt.NDArray[np.bool_]) -> Array:
    """Distance in pixels [H, W] float32 of every pixel to the nearest known one."""
    if not known.any():
        return np.full(known.shape, float(max(known.shape)), np.float32)
    return ndimage.distance_transform_edt(~known).astype(np.float32)
