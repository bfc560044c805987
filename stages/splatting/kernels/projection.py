"""Projection of Gaussians to the screen (EWA splatting), as a numba kernel.

A scene is one packed matrix [N, 11 + 3 K] float32 (K = spherical-harmonics coefficients a colour):

    0:3 mean | 3:7 quaternion wxyz | 7:10 log scale | 10 logit opacity | 11: harmonics, K x 3

and a projected Gaussian is one row of `screen` [N, 16] float32:

    0:2 centre (px) | 2:5 inverse 2D covariance a, b, c | 5 opacity, compensated if antialiased |
    6:8 half width, half height of the ellipse where alpha falls below its cut (px; negative: not
    visible) | 8 depth z | 9 inverse of the variance along y | 10 log2 of the opacity | 11 b / a |
    12 height of the ellipse's rightmost point above the centre | 13 1 / a | 14:16 nothing: a row is
    a cache line

Every kernel works in chunks of fixed length, so that its result does not depend on the number of
threads (a vectorised loop may round differently from its scalar remainder).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, inlined, kernel
from stages.splatting.lanes.types import WIDTH as LANES
from stages.splatting.lanes.vectors import (
    at_least,
    at_most,
    exponential,
    load_from,
    log2,
    root,
    spread,
    store_from,
    where,
)

Floats = npt.NDArray[np.float32]
F = np.float32

#: first column of the harmonics in the packed matrix
HARMONICS = 11
SCREEN_COLUMNS = 16
#: Gaussians per chunk
CHUNK = 256
#: columns of a row of screen gradients: centre 2, conic 3, opacity, |centre| 2; then the features
SCREEN_GRADIENTS = 8
#: columns of the gradient of a camera: twist (translation 3, rotation 3), fx, fy, cx, cy
CAMERA_GRADIENTS = 10
TWO_LN2 = F(2 * math.log(2))


@inlined
def rotation_rows(qw, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Rotation matrices of quaternions, row by row, and 1 / their lengths."""
    one, two = F(1), F(2)
    norm = one / root(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
    return (
        one - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz), two * (qx * qz + qw * qy),
        two * (qx * qy + qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx),
        two * (qx * qz - qw * qy), two * (qy * qz + qw * qx), one - two * (qx * qx + qy * qy),
        norm,
    )  # fmt: skip


@helper
def slope_limits(intrinsics, width, height):  # type: ignore[no-untyped-def]
    """Bounds of x/z and y/z between which the projection is linearised: the view plus 30 %."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    margin_x, margin_y = F(0.15) * F(width) / fx, F(0.15) * F(height) / fy
    return (
        -cx / fx - margin_x, (F(width) - cx) / fx + margin_x,
        -cy / fy - margin_y, (F(height) - cy) / fy + margin_y,
    )  # fmt: skip


@helper
def _project_chunk(  # type: ignore[no-untyped-def]
    chunk, packed, pose, intrinsics, width, height, near, low_pass, alpha_cut, antialiased, screen,
):  # fmt: skip
    """One chunk of `project_forward`."""
    number = packed.shape[0]
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, right, top, bottom = slope_limits(intrinsics, width, height)
    p00, p01, p02, p03 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    p10, p11, p12, p13 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    p20, p21, p22, p23 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    log_cut = math.log2(alpha_cut)
    one, zero = F(1), spread(F(0))
    start, end = chunk * CHUNK, min(number, (chunk + 1) * CHUNK)
    # the chunk's columns as rows, 16 Gaussians a vector
    given = np.zeros((HARMONICS, CHUNK), np.float32)
    result = np.zeros((SCREEN_COLUMNS, CHUNK), np.float32)
    for i in range(end - start):
        for column in range(HARMONICS):
            given[column, i] = packed[start + i, column]
    for k in range(0, end - start, LANES):
        x, y = load_from(given, k), load_from(given, CHUNK + k)
        z = load_from(given, 2 * CHUNK + k)
        px = p00 * x + p01 * y + p02 * z + p03
        py = p10 * x + p11 * y + p12 * z + p13
        pz = p20 * x + p21 * y + p22 * z + p23
        opacity = one / (exponential(zero - load_from(given, 10 * CHUNK + k)) + one)
        # written so that a NaN fails the test
        visible = (pz > near) & (opacity > alpha_cut)
        iz = one / where(visible, pz, one)
        qw, qx = load_from(given, 3 * CHUNK + k), load_from(given, 4 * CHUNK + k)
        qy, qz = load_from(given, 5 * CHUNK + k), load_from(given, 6 * CHUNK + k)
        r00, r01, r02, r10, r11, r12, r20, r21, r22, _ = rotation_rows(qw, qx, qy, qz)
        s0 = exponential(load_from(given, 7 * CHUNK + k))
        s1 = exponential(load_from(given, 8 * CHUNK + k))
        s2 = exponential(load_from(given, 9 * CHUNK + k))
        tx = at_most(at_least(px * iz, left), right)
        ty = at_most(at_least(py * iz, top), bottom)
        j00, j02, j11, j12 = iz * fx, tx * iz * -fx, iz * fy, ty * iz * -fy
        # rows of J W, then of J W R S, whose product with its transpose is the 2D covariance
        w00, w01, w02 = j00 * p00 + j02 * p20, j00 * p01 + j02 * p21, j00 * p02 + j02 * p22
        w10, w11, w12 = j11 * p10 + j12 * p20, j11 * p11 + j12 * p21, j11 * p12 + j12 * p22
        a00 = (w00 * r00 + w01 * r10 + w02 * r20) * s0
        a01 = (w00 * r01 + w01 * r11 + w02 * r21) * s1
        a02 = (w00 * r02 + w01 * r12 + w02 * r22) * s2
        a10 = (w10 * r00 + w11 * r10 + w12 * r20) * s0
        a11 = (w10 * r01 + w11 * r11 + w12 * r21) * s1
        a12 = (w10 * r02 + w11 * r12 + w12 * r22) * s2
        xx = a00 * a00 + a01 * a01 + a02 * a02
        xy = a00 * a10 + a01 * a11 + a02 * a12
        yy = a10 * a10 + a11 * a11 + a12 * a12
        # |a0 x a1|^2 is the determinant without the low-pass; the direct form loses all its
        # digits for a long thin Gaussian
        n0, n1, n2 = a01 * a12 - a02 * a11, a02 * a10 - a00 * a12, a00 * a11 - a01 * a10
        sharp = n0 * n0 + n1 * n1 + n2 * n2
        determinant = sharp + low_pass * (xx + yy + low_pass)
        xx += low_pass
        yy += low_pass
        visible = visible & (determinant > F(1e-12)) & (determinant < F(1e30))
        if antialiased == 1:
            opacity = opacity * root(sharp / determinant)
            visible = visible & (opacity > alpha_cut)
        opacity = where(visible, opacity, one)
        u, v = px * iz * fx + cx, py * iz * fy + cy
        log_opacity = log2(opacity)
        reach = (log_opacity - log_cut) * TWO_LN2
        half_width, half_height = root(reach * xx), root(reach * yy)
        visible = visible & (u + half_width > zero) & (u - half_width < F(width))
        visible = visible & (v + half_height > zero) & (v - half_height < F(height))
        inverse = one / determinant
        store_from(result, k, u)
        store_from(result, CHUNK + k, v)
        store_from(result, 2 * CHUNK + k, yy * inverse)
        store_from(result, 3 * CHUNK + k, zero - xy * inverse)
        store_from(result, 4 * CHUNK + k, xx * inverse)
        store_from(result, 5 * CHUNK + k, opacity)
        store_from(result, 6 * CHUNK + k, where(visible, half_width, F(-1)))
        store_from(result, 7 * CHUNK + k, half_height)
        store_from(result, 8 * CHUNK + k, pz)
        store_from(result, 9 * CHUNK + k, one / yy)
        store_from(result, 10 * CHUNK + k, log_opacity)
        store_from(result, 11 * CHUNK + k, zero - xy / yy)
        store_from(result, 12 * CHUNK + k, half_width * xy / xx)
        store_from(result, 13 * CHUNK + k, determinant / yy)
    for i in range(end - start):
        for column in range(SCREEN_COLUMNS):
            screen[start + i, column] = result[column, i]


@kernel(parallel=True)
def project_forward(  # type: ignore[no-untyped-def]
    packed: Floats, pose: Floats, intrinsics: Floats, width: int, height: int,
    near: np.float32, low_pass: np.float32, alpha_cut: np.float32, antialiased: int,
    screen: Floats,
):  # fmt: skip
    """Project every Gaussian; fills `screen` [N, 16].

    Args:
        packed: [N, 11 + 3 K] scene.
        pose: [3, 4] cam_from_world.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width, height: image size.
        near: Gaussians whose centre is nearer are not drawn.
        low_pass: variance added to the 2D covariance, in px^2.
        alpha_cut: contributions below this alpha are left out.
        antialiased: 1 to take from the opacity what the low-pass adds to the area (Mip-Splatting).
        screen: output.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _project_chunk(
            np.int64(chunk), packed, pose, intrinsics, width, height, near, low_pass, alpha_cut,
            antialiased, screen,
        )  # fmt: skip
