"""The gradient of the projection of Gaussians to the screen, as a numba kernel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.kernels.projection import (
    CAMERA_GRADIENTS,
    CHUNK,
    HARMONICS,
    rotation_rows,
    slope_limits,
)
from stages.splatting.lanes.types import WIDTH as LANES
from stages.splatting.lanes.vectors import (
    at_least,
    at_most,
    exponential,
    load_from,
    spread,
    store_from,
    sums,
    where,
)

Floats = npt.NDArray[np.float32]
F = np.float32


@helper
def _project_chunk_back(  # type: ignore[no-untyped-def]
    chunk, packed, pose, intrinsics, width, height, low_pass, antialiased, screen, screen_gradient,
    gradient, camera_parts,
):  # fmt: skip
    """One chunk of `project_backward`."""
    number = packed.shape[0]
    fx, fy = intrinsics[0], intrinsics[1]
    left, right, top, bottom = slope_limits(intrinsics, width, height)
    p00, p01, p02, p03 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    p10, p11, p12, p13 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    p20, p21, p22, p23 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    one, two, zero = F(1), F(2), spread(F(0))
    start, end = chunk * CHUNK, min(number, (chunk + 1) * CHUNK)
    # the chunk's columns as rows, 16 Gaussians a vector
    given = np.zeros((HARMONICS, CHUNK), np.float32)
    shown = np.zeros((6, CHUNK), np.float32)
    wanted = np.zeros((6, CHUNK), np.float32)
    result = np.empty((HARMONICS, CHUNK), np.float32)
    for i in range(end - start):
        row = start + i
        for column in range(HARMONICS):
            given[column, i] = packed[row, column]
        for column in range(6):
            shown[column, i] = screen[row, 2 + column]
            wanted[column, i] = screen_gradient[row, column]
    for i in range(end - start, CHUNK):
        shown[4, i] = F(-1)
    c0 = c1 = c2 = c3 = c4 = c5 = c6 = c7 = c8 = c9 = zero
    for k in range(0, end - start, LANES):
        visible = load_from(shown, 4 * CHUNK + k) >= F(0)
        x, y, z = (
            load_from(given, k),
            load_from(given, CHUNK + k),
            load_from(given, 2 * CHUNK + k),
        )
        px = p00 * x + p01 * y + p02 * z + p03
        py = p10 * x + p11 * y + p12 * z + p13
        pz = where(visible, p20 * x + p21 * y + p22 * z + p23, one)
        qw = where(visible, load_from(given, 3 * CHUNK + k), one)
        qx, qy = load_from(given, 4 * CHUNK + k), load_from(given, 5 * CHUNK + k)
        qz = load_from(given, 6 * CHUNK + k)
        r00, r01, r02, r10, r11, r12, r20, r21, r22, norm = rotation_rows(qw, qx, qy, qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        s0 = exponential(load_from(given, 7 * CHUNK + k))
        s1 = exponential(load_from(given, 8 * CHUNK + k))
        s2 = exponential(load_from(given, 9 * CHUNK + k))
        iz = one / pz
        slope_x, slope_y = px * iz, py * iz
        tx = at_most(at_least(slope_x, left), right)
        ty = at_most(at_least(slope_y, top), bottom)
        j00, j02, j11, j12 = iz * fx, tx * iz * -fx, iz * fy, ty * iz * -fy
        # B = W R S (the Gaussian's axes in the camera), A = J B
        m00, m01, m02 = r00 * s0, r01 * s1, r02 * s2
        m10, m11, m12 = r10 * s0, r11 * s1, r12 * s2
        m20, m21, m22 = r20 * s0, r21 * s1, r22 * s2
        b00 = p00 * m00 + p01 * m10 + p02 * m20
        b01 = p00 * m01 + p01 * m11 + p02 * m21
        b02 = p00 * m02 + p01 * m12 + p02 * m22
        b10 = p10 * m00 + p11 * m10 + p12 * m20
        b11 = p10 * m01 + p11 * m11 + p12 * m21
        b12 = p10 * m02 + p11 * m12 + p12 * m22
        b20 = p20 * m00 + p21 * m10 + p22 * m20
        b21 = p20 * m01 + p21 * m11 + p22 * m21
        b22 = p20 * m02 + p21 * m12 + p22 * m22
        a00, a01, a02 = j00 * b00 + j02 * b20, j00 * b01 + j02 * b21, j00 * b02 + j02 * b22
        a10, a11, a12 = j11 * b10 + j12 * b20, j11 * b11 + j12 * b21, j11 * b12 + j12 * b22

        # conic -> covariance: dL/dSigma = -Q (dL/dQ) Q
        qa, qb = load_from(shown, k), load_from(shown, CHUNK + k)
        qc, opacity = load_from(shown, 2 * CHUNK + k), load_from(shown, 3 * CHUNK + k)
        ga, gb = load_from(wanted, 2 * CHUNK + k), load_from(wanted, 3 * CHUNK + k) * F(0.5)
        gc = load_from(wanted, 4 * CHUNK + k)
        e00, e01 = ga * qa + gb * qb, ga * qb + gb * qc
        e10, e11 = gb * qa + gc * qb, gb * qb + gc * qc
        dxx = zero - (qa * e00 + qb * e10)
        dxy, dyy = zero - (qa * e01 + qb * e11), zero - (qb * e01 + qc * e11)
        da00, da01, da02 = (
            two * (dxx * a00 + dxy * a10), two * (dxx * a01 + dxy * a11),
            two * (dxx * a02 + dxy * a12),
        )  # fmt: skip
        da10, da11, da12 = (
            two * (dxy * a00 + dyy * a10), two * (dxy * a01 + dyy * a11),
            two * (dxy * a02 + dyy * a12),
        )  # fmt: skip
        faded = load_from(wanted, 5 * CHUNK + k) * opacity
        if antialiased == 1:
            # opacity = sigmoid * |n| / sqrt(det), n = a0 x a1, det = |n|^2 + low-pass part
            n0, n1, n2 = a01 * a12 - a02 * a11, a02 * a10 - a00 * a12, a00 * a11 - a01 * a10
            sharp = n0 * n0 + n1 * n1 + n2 * n2
            trace = a00 * a00 + a01 * a01 + a02 * a02 + a10 * a10 + a11 * a11 + a12 * a12
            determinant = sharp + low_pass * (trace + low_pass)
            # d log(opacity) = by_n d|n|^2 / 2 - by_trace d(trace) / 2
            by_trace = faded * low_pass / determinant
            by_n = by_trace * (trace + low_pass) / at_least(sharp, F(1e-30))
            da00 += by_n * (a11 * n2 - a12 * n1) - by_trace * a00
            da01 += by_n * (a12 * n0 - a10 * n2) - by_trace * a01
            da02 += by_n * (a10 * n1 - a11 * n0) - by_trace * a02
            da10 += by_n * (n1 * a02 - n2 * a01) - by_trace * a10
            da11 += by_n * (n2 * a00 - n0 * a02) - by_trace * a11
            da12 += by_n * (n0 * a01 - n1 * a00) - by_trace * a12
        dj00 = da00 * b00 + da01 * b01 + da02 * b02
        dj02 = da00 * b20 + da01 * b21 + da02 * b22
        dj11 = da10 * b10 + da11 * b11 + da12 * b12
        dj12 = da10 * b20 + da11 * b21 + da12 * b22
        db00, db01, db02 = j00 * da00, j00 * da01, j00 * da02
        db10, db11, db12 = j11 * da10, j11 * da11, j11 * da12
        db20, db21, db22 = (
            j02 * da00 + j12 * da10, j02 * da01 + j12 * da11, j02 * da02 + j12 * da12
        )  # fmt: skip
        # d(R S) = W^T dB
        dm00 = p00 * db00 + p10 * db10 + p20 * db20
        dm01 = p00 * db01 + p10 * db11 + p20 * db21
        dm02 = p00 * db02 + p10 * db12 + p20 * db22
        dm10 = p01 * db00 + p11 * db10 + p21 * db20
        dm11 = p01 * db01 + p11 * db11 + p21 * db21
        dm12 = p01 * db02 + p11 * db12 + p21 * db22
        dm20 = p02 * db00 + p12 * db10 + p22 * db20
        dm21 = p02 * db01 + p12 * db11 + p22 * db21
        dm22 = p02 * db02 + p12 * db12 + p22 * db22
        store_from(result, 7 * CHUNK + k, (dm00 * r00 + dm10 * r10 + dm20 * r20) * s0)
        store_from(result, 8 * CHUNK + k, (dm01 * r01 + dm11 * r11 + dm21 * r21) * s1)
        store_from(result, 9 * CHUNK + k, (dm02 * r02 + dm12 * r12 + dm22 * r22) * s2)
        dm00, dm10, dm20 = dm00 * s0, dm10 * s0, dm20 * s0
        dm01, dm11, dm21 = dm01 * s1, dm11 * s1, dm21 * s1
        dm02, dm12, dm22 = dm02 * s2, dm12 * s2, dm22 * s2
        dqw = two * (qx * (dm21 - dm12) + qy * (dm02 - dm20) + qz * (dm10 - dm01))
        dqx = two * (
            qy * (dm01 + dm10) + qz * (dm02 + dm20) + qw * (dm21 - dm12)
            - two * qx * (dm11 + dm22)
        )  # fmt: skip
        dqy = two * (
            qx * (dm01 + dm10) + qz * (dm12 + dm21) + qw * (dm02 - dm20)
            - two * qy * (dm00 + dm22)
        )  # fmt: skip
        dqz = two * (
            qx * (dm02 + dm20) + qy * (dm12 + dm21) + qw * (dm10 - dm01)
            - two * qz * (dm00 + dm11)
        )  # fmt: skip
        along = dqw * qw + dqx * qx + dqy * qy + dqz * qz
        store_from(result, 3 * CHUNK + k, (dqw - along * qw) * norm)
        store_from(result, 4 * CHUNK + k, (dqx - along * qx) * norm)
        store_from(result, 5 * CHUNK + k, (dqy - along * qy) * norm)
        store_from(result, 6 * CHUNK + k, (dqz - along * qz) * norm)
        logit = load_from(given, 10 * CHUNK + k)
        store_from(result, 10 * CHUNK + k, faded / (exponential(logit) + one))

        # centre in the camera: through u, v, and through the Jacobian
        gu, gv = load_from(wanted, k), load_from(wanted, CHUNK + k)
        dpx, dpy = gu * fx * iz, gv * fy * iz
        dpz = zero - (gu * fx * px + gv * fy * py) * iz * iz
        dpz -= (dj00 * j00 + dj02 * j02 + dj11 * j11 + dj12 * j12) * iz
        dfx = gu * slope_x + dj00 * iz
        dfy = gv * slope_y + dj11 * iz
        # at the border the slope is held, whose distance from the principal point is in pixels
        free = (slope_x > left) & (slope_x < right)
        inner, outer = where(free, dj02 * iz, zero), where(free, zero, dj02 * iz)
        dpx -= inner * fx * iz
        dpz += inner * fx * slope_x * iz
        dfx -= inner * tx
        dcx = gu + outer
        free = (slope_y > top) & (slope_y < bottom)
        inner, outer = where(free, dj12 * iz, zero), where(free, zero, dj12 * iz)
        dpy -= inner * fy * iz
        dpz += inner * fy * slope_y * iz
        dfy -= inner * ty
        dcy = gv + outer
        store_from(result, k, p00 * dpx + p10 * dpy + p20 * dpz)
        store_from(result, CHUNK + k, p01 * dpx + p11 * dpy + p21 * dpz)
        store_from(result, 2 * CHUNK + k, p02 * dpx + p12 * dpy + p22 * dpz)
        twist0 = py * dpz - pz * dpy
        twist0 += b10 * db20 - b20 * db10 + b11 * db21 - b21 * db11 + b12 * db22 - b22 * db12
        twist1 = pz * dpx - px * dpz
        twist1 += b20 * db00 - b00 * db20 + b21 * db01 - b01 * db21 + b22 * db02 - b02 * db22
        twist2 = px * dpy - py * dpx
        twist2 += b00 * db10 - b10 * db00 + b01 * db11 - b11 * db01 + b02 * db12 - b12 * db02
        c0 += where(visible, dpx, zero)
        c1 += where(visible, dpy, zero)
        c2 += where(visible, dpz, zero)
        c3 += where(visible, twist0, zero)
        c4 += where(visible, twist1, zero)
        c5 += where(visible, twist2, zero)
        c6 += where(visible, dfx, zero)
        c7 += where(visible, dfy, zero)
        c8 += where(visible, dcx, zero)
        c9 += where(visible, dcy, zero)
    for i in range(end - start):
        row = start + i
        seen = shown[4, i] >= F(0)
        for column in range(HARMONICS):
            gradient[row, column] = result[column, i] if seen else F(0)
    total = np.empty(LANES, np.float32)
    store_from(
        total,
        0,
        sums((c0, c1, c2, c3, c4, c5, c6, c7, c8, c9, zero, zero, zero, zero, zero, zero)),
    )
    for column in range(CAMERA_GRADIENTS):
        camera_parts[chunk, column] = total[column]


@kernel(parallel=True)
def project_backward(  # type: ignore[no-untyped-def]
    packed: Floats, pose: Floats, intrinsics: Floats, width: int, height: int,
    low_pass: np.float32, antialiased: int, screen: Floats, screen_gradient: Floats,
    gradient: Floats, camera_parts: Floats,
):  # fmt: skip
    """Gradients of means, quaternions, log scales and logit opacities, and of the camera.

    Args:
        packed, pose, intrinsics, width, height, low_pass, antialiased, screen: as in
            `project_forward`.
        screen_gradient: [N, >= 8] per Gaussian: centre (2), conic a, b, c (3), opacity.
        gradient: [N, 11 + 3 K]; columns 0:11 are set (rows of invisible Gaussians to 0).
        camera_parts: [ceil(N / CHUNK), 10] per chunk: twist (translation 3, rotation 3) of
            cam_from_world, multiplied from the left, then fx, fy, cx, cy. To be summed in order.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _project_chunk_back(
            np.int64(chunk), packed, pose, intrinsics, width, height, low_pass, antialiased, screen,
            screen_gradient, gradient, camera_parts,
        )  # fmt: skip
