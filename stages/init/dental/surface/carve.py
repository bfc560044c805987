"""Silhouettes: no part of a chart may lie where a photograph shows that there is nothing.

Crowns and gum that one photograph alone shows have no match, but the others have seen the dark
beside them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import kernel
from stages.init.dental.surface.fit import fit_offsets, reweighted
from stages.init.dental.surface.photos.photo import Photo

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: How often the chart is fitted anew to where it has to be.
_ROUNDS = 5
#: The weight by which it is held there, against 1 of a full correlation: it only has to bend what
#: no match holds.
_HOLD = 0.2


def in_void(points: Array32, normals: Array32, offsets: Array32, photos: list[Photo]) -> Mask:
    """Which offsets of a chart along its normals some photograph rules out.

    Args:
        points, normals: [H, W, 3] float32.
        offsets: [D] float32, mm.
        photos: with `Photo.void`.

    Returns:
        [H, W, D] bool.
    """
    found = np.zeros((*points.shape[:2], len(offsets)), bool)
    for photo in photos:
        if photo.void.any():
            _mark(points, normals, offsets, photo.void, photo.camera.astype(np.float32), found)
    return found


@kernel(parallel=True)
def _mark(points, normals, offsets, void, c, found):  # type: ignore[no-untyped-def]
    rows, cols = points.shape[:2]
    height, width = void.shape
    for i in prange(rows):
        for j in range(cols):
            for d in range(offsets.shape[0]):
                X = points[i, j, 0] + offsets[d] * normals[i, j, 0]
                Y = points[i, j, 1] + offsets[d] * normals[i, j, 1]
                Z = points[i, j, 2] + offsets[d] * normals[i, j, 2]
                z = c[6] * X + c[7] * Y + c[8] * Z + c[11]
                if z < np.float32(1):
                    continue
                x = c[12] * (c[0] * X + c[1] * Y + c[2] * Z + c[9]) / z + c[13]
                y = c[12] * (c[3] * X + c[4] * Y + c[5] * Z + c[10]) / z + c[14]
                if x >= 0 and y >= 0 and x < width and y < height and void[int(y), int(x)] > 0:
                    found[i, j, d] = True


@kernel(parallel=True)
def _nearest_outside(void, plane, target):  # type: ignore[no-untyped-def]
    """The nearest plane outside the void into `target` [H, W]; -1 where all planes are inside."""
    rows, cols, count = void.shape
    for i in prange(rows):
        for j in range(cols):
            at = plane[i, j]
            target[i, j] = -1
            for step in range(count):
                if at - step >= 0 and not void[i, j, at - step]:
                    target[i, j] = at - step
                    break
                if at + step < count and not void[i, j, at + step]:
                    target[i, j] = at + step
                    break


def carved(
    offset: Array32, weight: Array32, stiffness: float, anchor: float, outlier: float, void: Mask,
    steps: Array32,
) -> Array32:  # fmt: skip
    """Fit a smooth field to offsets, as `fit_offsets`, that keeps out of the void.

    What lies inside is held at the nearest offset outside, and the field fitted again, until all of
    it is outside or some rounds are over. Which offsets are wrong is decided before.

    Args:
        offset, weight, stiffness, anchor, outlier: of `fit_offsets`.
        void: [H, W, D] bool.
        steps: [D] float32 its offsets, evenly spaced.
    """
    fitted = fit_offsets(offset, weight, stiffness, anchor, outlier)
    trust = reweighted(offset, weight, fitted, outlier)
    held, target = np.zeros_like(fitted), np.zeros_like(fitted)
    nearest = np.empty(fitted.shape, np.int64)
    step = steps[1] - steps[0]
    for _ in range(_ROUNDS):
        plane = np.rint((fitted - steps[0]) / step).astype(np.int64)
        plane = np.clip(plane, 0, len(steps) - 1)
        inside = np.take_along_axis(void, plane[..., None], 2)[..., 0]
        if not inside.any():
            break
        _nearest_outside(void, plane, nearest)
        inside &= nearest >= 0
        if not inside.any():
            break
        held[inside] = _HOLD
        target[inside] = steps[nearest[inside]]
        fitted = fit_offsets(
            offset, trust, stiffness, anchor, outlier, held, target, reweightings=0
        )  # fmt: skip
    return fitted
