"""Geometric consistency between the depth maps of several views.

A depth is believed when other views, asked at the pixel where it projects to, report the same
surface; it is refuted when they see through it (the test of COLMAP's and MVSNet's fusion).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import each, helper, kernel

Array = npt.NDArray[np.float32]


def stacked(images: Sequence[Array], outside: float | np.float32 = 0.0) -> Array:
    """Images or maps of different size as one array [V, H_max, W_max(, C)] float32."""
    height = max(image.shape[0] for image in images)
    width = max(image.shape[1] for image in images)
    stack = np.full((len(images), height, width, *images[0].shape[2:]), outside, np.float32)
    for v, image in enumerate(images):
        stack[v, : image.shape[0], : image.shape[1]] = image
    return stack


def camera_table(cameras: Sequence[Camera]) -> npt.NDArray[np.float64]:
    """[V, 18] float64: fx, fy, cx, cy, width, height, rotation row-major, translation."""
    rows = [
        [c.fx, c.fy, c.cx, c.cy, c.width, c.height, *c.rotation.ravel(), *c.translation]
        for c in cameras
    ]
    return np.array(rows, np.float64)


@helper
def _lift(c, x, y, z):  # type: ignore[no-untyped-def]
    """World point of pixel (x, y) at depth z."""
    a = (x + 0.5 - c[2]) / c[0] * z - c[15]
    b = (y + 0.5 - c[3]) / c[1] * z - c[16]
    d = z - c[17]
    return (
        c[6] * a + c[9] * b + c[12] * d,
        c[7] * a + c[10] * b + c[13] * d,
        c[8] * a + c[11] * b + c[14] * d,
    )


@helper
def _drop(c, X, Y, Z):  # type: ignore[no-untyped-def]
    """Pixel and depth of a world point (pixel indices: centre of the first is 0, 0)."""
    a = c[6] * X + c[7] * Y + c[8] * Z + c[15]
    b = c[9] * X + c[10] * Y + c[11] * Z + c[16]
    z = c[12] * X + c[13] * Y + c[14] * Z + c[17]
    if z <= 1e-9:
        return -1.0, -1.0, -1.0
    return c[0] * a / z + c[2] - 0.5, c[1] * b / z + c[3] - 0.5, z


@kernel(nogil=True)
def _check_row(  # type: ignore[no-untyped-def]
    y, index, others, depths, weights, cameras, relative, pixels, front, agree, conflict, fused,
    angle,
):  # fmt: skip
    """One row of `check`."""
    here = cameras[index]
    for x in range(agree.shape[1]):
        z = np.float64(depths[index, y, x])
        if z <= 0:
            continue
        X, Y, Z = _lift(here, x, y, z)
        mean = z * weights[index, y, x]
        mass = np.float64(weights[index, y, x])
        ox = X + here[6] * here[15] + here[9] * here[16] + here[12] * here[17]
        oy = Y + here[7] * here[15] + here[10] * here[16] + here[13] * here[17]
        oz = Z + here[8] * here[15] + here[11] * here[16] + here[14] * here[17]
        length = np.sqrt(ox * ox + oy * oy + oz * oz)
        widest = 0.0
        for v in others:
            there = cameras[v]
            u, w, zv = _drop(there, X, Y, Z)
            if zv <= 0:
                continue
            j = np.int64(np.floor(u + 0.5))
            i = np.int64(np.floor(w + 0.5))
            if i < 0 or j < 0 or i >= there[5] or j >= there[4]:
                continue
            seen = np.float64(depths[v, i, j])
            if seen <= 0:
                continue
            if zv < seen * (1 - front):
                conflict[y, x] += 1
                continue
            if abs(seen - zv) > relative * zv:
                continue
            A, B, C = _lift(there, j, i, seen)
            back_u, back_w, _ = _drop(here, A, B, C)
            if (back_u - x) ** 2 + (back_w - y) ** 2 > pixels * pixels:
                continue
            agree[y, x] += 1
            # Its surface moved to our ray: correct for the sub-pixel lookup to first order by
            # taking the difference of depths at its pixel instead of its depth.
            value = z + (seen - zv) * z / zv
            weight = np.float64(weights[v, i, j])
            mean += weight * value
            mass += weight
            px = X + there[6] * there[15] + there[9] * there[16] + there[12] * there[17]
            py = Y + there[7] * there[15] + there[10] * there[16] + there[13] * there[17]
            pz = Z + there[8] * there[15] + there[11] * there[16] + there[14] * there[17]
            norm = np.sqrt(px * px + py * py + pz * pz)
            cosine = (ox * px + oy * py + oz * pz) / max(length * norm, 1e-12)
            widest = max(widest, np.arccos(min(max(cosine, -1.0), 1.0)))
        fused[y, x] = np.float32(mean / max(mass, 1e-12))
        angle[y, x] = np.float32(widest)


def check(
    index: int,
    depths: Array,
    weights: Array,
    cameras: npt.NDArray[np.float64],
    shape: tuple[int, int],
    relative: float,
    pixels: float,
    front: float,
    others: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], Array, Array]:
    """Ask other views about the depth map of one.

    Args:
        index: the view in question.
        depths: [V, H_max, W_max] float32 from `stacked`; 0 where there is none.
        weights: [V, H_max, W_max] float32 > 0, of each depth in the fused mean.
        cameras: [V, 18] float64 from `camera_table`.
        shape: (H, W) of the view.
        relative: largest relative difference of depth that agrees.
        pixels: largest reprojection error in pixels that agrees.
        front: a depth that lies by this share in front of what another view sees is refuted.
        others: [K] int64, the views to ask.

    Returns:
        Agreeing views [H, W] int32; refuting views [H, W] int32; mean depth of the view and those
        that agree [H, W] float32; widest triangulation angle among them [H, W] float32 radians.
    """
    agree = np.zeros(shape, np.int32)
    conflict = np.zeros(shape, np.int32)
    fused = np.zeros(shape, np.float32)
    angle = np.zeros(shape, np.float32)
    each(
        _check_row, shape[0], int(index), others, depths, weights, cameras, float(relative),
        float(pixels), float(front), agree, conflict, fused, angle,
    )  # fmt: skip
    return agree, conflict, fused, angle
