"""Projection of Gaussians to the screen (EWA splatting) and its gradient, as numba kernels.

A scene is one packed matrix [N, 11 + 3 K] float32 (K = spherical-harmonics coefficients a colour):

    0:3 mean | 3:7 quaternion wxyz | 7:10 log scale | 10 logit opacity | 11: harmonics, K x 3

and a projected Gaussian is one row of `screen` [N, 12] float32:

    0:2 centre (px) | 2:5 inverse 2D covariance a, b, c | 5 opacity, compensated if antialiased |
    6:8 half width, half height of the ellipse where alpha falls below its cut (px; negative: not
    visible) | 8 depth z | 9 inverse of the variance along y | 10 log2 of the opacity | 11 b / a

Every kernel works in chunks of fixed length, so that its result does not depend on the number of
threads (a vectorised loop may round differently from its scalar remainder). The functions that a
kernel calls are in its own file, because numba's cache looks at the time stamp of that file alone.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit, prange

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32

#: first column of the harmonics in the packed matrix
HARMONICS = 11
SCREEN_COLUMNS = 12
#: Gaussians per chunk
CHUNK = 256
#: columns of a row of screen gradients: centre 2, conic 3, opacity, |centre| 2; then the features
SCREEN_GRADIENTS = 8
#: columns of the gradient of a camera: twist (translation 3, rotation 3), fx, fy, cx, cy
CAMERA_GRADIENTS = 10


@njit(error_model="numpy")
def _rotation(qw, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Rotation matrix of a unit quaternion, row by row."""
    one, two = F(1), F(2)
    return (
        one - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz), two * (qx * qz + qw * qy),
        two * (qx * qy + qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx),
        two * (qx * qz - qw * qy), two * (qy * qz + qw * qx), one - two * (qx * qx + qy * qy),
    )  # fmt: skip


@njit(error_model="numpy")
def _to_camera(pose, x, y, z):  # type: ignore[no-untyped-def]
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@njit(error_model="numpy")
def _slope_limits(intrinsics, width, height):  # type: ignore[no-untyped-def]
    """Bounds of x/z and y/z between which the projection is linearised: the view plus 30 %."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    margin_x, margin_y = F(0.15) * F(width) / fx, F(0.15) * F(height) / fy
    return (
        -cx / fx - margin_x, (F(width) - cx) / fx + margin_x,
        -cy / fy - margin_y, (F(height) - cy) / fy + margin_y,
    )  # fmt: skip


@njit(parallel=True, cache=True, error_model="numpy")
def project_forward(  # type: ignore[no-untyped-def]
    packed: Floats, pose: Floats, intrinsics: Floats, width: int, height: int,
    near: np.float32, low_pass: np.float32, alpha_cut: np.float32, antialiased: int,
    screen: Floats,
):  # fmt: skip
    """Project every Gaussian; fills `screen` [N, 12].

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
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, right, top, bottom = _slope_limits(intrinsics, width, height)
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            screen[i, 6] = F(-1)
            px, py, pz = _to_camera(pose, packed[i, 0], packed[i, 1], packed[i, 2])
            screen[i, 8] = pz
            # written so that a NaN fails the test
            if not pz > near:
                continue
            opacity = F(1) / (F(1) + math.exp(-packed[i, 10]))
            if not opacity > alpha_cut:
                continue
            qw, qx, qy, qz = packed[i, 3], packed[i, 4], packed[i, 5], packed[i, 6]
            norm = F(1) / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(
                qw * norm, qx * norm, qy * norm, qz * norm
            )
            s0, s1, s2 = math.exp(packed[i, 7]), math.exp(packed[i, 8]), math.exp(packed[i, 9])
            inverse_z = F(1) / pz
            tx = min(right, max(left, px * inverse_z))
            ty = min(bottom, max(top, py * inverse_z))
            j00, j02 = fx * inverse_z, -fx * tx * inverse_z
            j11, j12 = fy * inverse_z, -fy * ty * inverse_z
            # rows of J W, then of J W R S, whose product with its transpose is the 2D covariance
            w00 = j00 * pose[0, 0] + j02 * pose[2, 0]
            w01 = j00 * pose[0, 1] + j02 * pose[2, 1]
            w02 = j00 * pose[0, 2] + j02 * pose[2, 2]
            w10 = j11 * pose[1, 0] + j12 * pose[2, 0]
            w11 = j11 * pose[1, 1] + j12 * pose[2, 1]
            w12 = j11 * pose[1, 2] + j12 * pose[2, 2]
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
            n0 = a01 * a12 - a02 * a11
            n1 = a02 * a10 - a00 * a12
            n2 = a00 * a11 - a01 * a10
            sharp = n0 * n0 + n1 * n1 + n2 * n2
            determinant = sharp + low_pass * (xx + yy + low_pass)
            xx += low_pass
            yy += low_pass
            if not (determinant > F(1e-12) and determinant < F(1e30)):
                continue
            if antialiased == 1:
                opacity *= math.sqrt(sharp / determinant)
                if not opacity > alpha_cut:
                    continue
            u, v = fx * px * inverse_z + cx, fy * py * inverse_z + cy
            reach = F(2) * math.log(opacity / alpha_cut)
            half_width, half_height = math.sqrt(reach * xx), math.sqrt(reach * yy)
            if not (
                u + half_width > F(0) and u - half_width < F(width)
                and v + half_height > F(0) and v - half_height < F(height)
            ):  # fmt: skip
                continue
            inverse = F(1) / determinant
            screen[i, 0] = u
            screen[i, 1] = v
            screen[i, 2] = yy * inverse
            screen[i, 3] = -xy * inverse
            screen[i, 4] = xx * inverse
            screen[i, 5] = opacity
            screen[i, 6] = half_width
            screen[i, 7] = half_height
            screen[i, 9] = F(1) / yy
            screen[i, 10] = math.log2(opacity)
            screen[i, 11] = -xy / yy


@njit(parallel=True, cache=True, error_model="numpy")
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
    fx, fy = intrinsics[0], intrinsics[1]
    left, right, top, bottom = _slope_limits(intrinsics, width, height)
    two = F(2)
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        camera = np.zeros(CAMERA_GRADIENTS, np.float32)
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            for column in range(HARMONICS):
                gradient[i, column] = F(0)
            if screen[i, 6] < F(0):
                continue
            px, py, pz = _to_camera(pose, packed[i, 0], packed[i, 1], packed[i, 2])
            qw, qx, qy, qz = packed[i, 3], packed[i, 4], packed[i, 5], packed[i, 6]
            norm = F(1) / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
            qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(qw, qx, qy, qz)
            s0, s1, s2 = math.exp(packed[i, 7]), math.exp(packed[i, 8]), math.exp(packed[i, 9])
            iz = F(1) / pz
            slope_x, slope_y = px * iz, py * iz
            tx, ty = min(right, max(left, slope_x)), min(bottom, max(top, slope_y))
            j00, j02, j11, j12 = fx * iz, -fx * tx * iz, fy * iz, -fy * ty * iz
            # B = W R S (the Gaussian's axes in the camera), A = J B
            m00, m01, m02 = r00 * s0, r01 * s1, r02 * s2
            m10, m11, m12 = r10 * s0, r11 * s1, r12 * s2
            m20, m21, m22 = r20 * s0, r21 * s1, r22 * s2
            b00 = pose[0, 0] * m00 + pose[0, 1] * m10 + pose[0, 2] * m20
            b01 = pose[0, 0] * m01 + pose[0, 1] * m11 + pose[0, 2] * m21
            b02 = pose[0, 0] * m02 + pose[0, 1] * m12 + pose[0, 2] * m22
            b10 = pose[1, 0] * m00 + pose[1, 1] * m10 + pose[1, 2] * m20
            b11 = pose[1, 0] * m01 + pose[1, 1] * m11 + pose[1, 2] * m21
            b12 = pose[1, 0] * m02 + pose[1, 1] * m12 + pose[1, 2] * m22
            b20 = pose[2, 0] * m00 + pose[2, 1] * m10 + pose[2, 2] * m20
            b21 = pose[2, 0] * m01 + pose[2, 1] * m11 + pose[2, 2] * m21
            b22 = pose[2, 0] * m02 + pose[2, 1] * m12 + pose[2, 2] * m22
            a00, a01, a02 = j00 * b00 + j02 * b20, j00 * b01 + j02 * b21, j00 * b02 + j02 * b22
            a10, a11, a12 = j11 * b10 + j12 * b20, j11 * b11 + j12 * b21, j11 * b12 + j12 * b22

            # conic -> covariance: dL/dSigma = -Q (dL/dQ) Q
            qa, qb, qc = screen[i, 2], screen[i, 3], screen[i, 4]
            ga, gb, gc = (
                screen_gradient[i, 2],
                F(0.5) * screen_gradient[i, 3],
                screen_gradient[i, 4],
            )
            e00, e01 = ga * qa + gb * qb, ga * qb + gb * qc
            e10, e11 = gb * qa + gc * qb, gb * qb + gc * qc
            dxx, dxy, dyy = -(qa * e00 + qb * e10), -(qa * e01 + qb * e11), -(qb * e01 + qc * e11)
            da00, da01, da02 = (
                two * (dxx * a00 + dxy * a10), two * (dxx * a01 + dxy * a11),
                two * (dxx * a02 + dxy * a12),
            )  # fmt: skip
            da10, da11, da12 = (
                two * (dxy * a00 + dyy * a10), two * (dxy * a01 + dyy * a11),
                two * (dxy * a02 + dyy * a12),
            )  # fmt: skip
            faded = screen_gradient[i, 5] * screen[i, 5]
            if antialiased == 1:
                # opacity = sigmoid * |n| / sqrt(det), n = a0 x a1, det = |n|^2 + low-pass part
                n0, n1, n2 = a01 * a12 - a02 * a11, a02 * a10 - a00 * a12, a00 * a11 - a01 * a10
                sharp = n0 * n0 + n1 * n1 + n2 * n2
                trace = a00 * a00 + a01 * a01 + a02 * a02 + a10 * a10 + a11 * a11 + a12 * a12
                determinant = sharp + low_pass * (trace + low_pass)
                # d log(opacity) = by_n d|n|^2 / 2 - by_trace d(trace) / 2
                by_trace = faded * low_pass / determinant
                by_n = by_trace * (trace + low_pass) / max(sharp, F(1e-30))
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
            dm00 = pose[0, 0] * db00 + pose[1, 0] * db10 + pose[2, 0] * db20
            dm01 = pose[0, 0] * db01 + pose[1, 0] * db11 + pose[2, 0] * db21
            dm02 = pose[0, 0] * db02 + pose[1, 0] * db12 + pose[2, 0] * db22
            dm10 = pose[0, 1] * db00 + pose[1, 1] * db10 + pose[2, 1] * db20
            dm11 = pose[0, 1] * db01 + pose[1, 1] * db11 + pose[2, 1] * db21
            dm12 = pose[0, 1] * db02 + pose[1, 1] * db12 + pose[2, 1] * db22
            dm20 = pose[0, 2] * db00 + pose[1, 2] * db10 + pose[2, 2] * db20
            dm21 = pose[0, 2] * db01 + pose[1, 2] * db11 + pose[2, 2] * db21
            dm22 = pose[0, 2] * db02 + pose[1, 2] * db12 + pose[2, 2] * db22
            gradient[i, 7] = (dm00 * r00 + dm10 * r10 + dm20 * r20) * s0
            gradient[i, 8] = (dm01 * r01 + dm11 * r11 + dm21 * r21) * s1
            gradient[i, 9] = (dm02 * r02 + dm12 * r12 + dm22 * r22) * s2
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
            gradient[i, 3] = (dqw - along * qw) * norm
            gradient[i, 4] = (dqx - along * qx) * norm
            gradient[i, 5] = (dqy - along * qy) * norm
            gradient[i, 6] = (dqz - along * qz) * norm
            gradient[i, 10] = faded / (F(1) + math.exp(packed[i, 10]))

            # centre in the camera: through u, v, and through the Jacobian
            gu, gv = screen_gradient[i, 0], screen_gradient[i, 1]
            dpx, dpy = gu * fx * iz, gv * fy * iz
            dpz = -(gu * fx * px + gv * fy * py) * iz * iz
            dpz -= (dj00 * j00 + dj02 * j02 + dj11 * j11 + dj12 * j12) * iz
            dfx = gu * slope_x + dj00 * iz
            dfy = gv * slope_y + dj11 * iz
            dcx, dcy = gu, gv
            if left < slope_x < right:
                dpx -= dj02 * fx * iz * iz
                dpz += dj02 * fx * slope_x * iz * iz
                dfx -= dj02 * tx * iz
            else:
                # held at the border, whose distance from the principal point is in pixels
                dcx += dj02 * iz
            if top < slope_y < bottom:
                dpy -= dj12 * fy * iz * iz
                dpz += dj12 * fy * slope_y * iz * iz
                dfy -= dj12 * ty * iz
            else:
                dcy += dj12 * iz
            gradient[i, 0] = pose[0, 0] * dpx + pose[1, 0] * dpy + pose[2, 0] * dpz
            gradient[i, 1] = pose[0, 1] * dpx + pose[1, 1] * dpy + pose[2, 1] * dpz
            gradient[i, 2] = pose[0, 2] * dpx + pose[1, 2] * dpy + pose[2, 2] * dpz
            camera[0] += dpx
            camera[1] += dpy
            camera[2] += dpz
            camera[3] += py * dpz - pz * dpy
            camera[3] += b10 * db20 - b20 * db10 + b11 * db21 - b21 * db11 + b12 * db22 - b22 * db12
            camera[4] += pz * dpx - px * dpz
            camera[4] += b20 * db00 - b00 * db20 + b21 * db01 - b01 * db21 + b22 * db02 - b02 * db22
            camera[5] += px * dpy - py * dpx
            camera[5] += b00 * db10 - b10 * db00 + b01 * db11 - b11 * db01 + b02 * db12 - b12 * db02
            camera[6] += dfx
            camera[7] += dfy
            camera[8] += dcx
            camera[9] += dcy
        for k in range(CAMERA_GRADIENTS):
            camera_parts[chunk, k] = camera[k]
