"""Features of the Gaussians in one view: colour from spherical harmonics, depth, flow.

Harmonics are evaluated in the world frame, along the ray from the camera to the Gaussian, with the
signs and the order of 3DGS, so that a `.ply` looks the same in every viewer.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.kernels.projection import CAMERA_GRADIENTS, CHUNK, HARMONICS

Floats = npt.NDArray[np.float32]
F = np.float32

#: of the harmonics, by degree; a colour is .5 + C0 times its constant
C0 = F(0.28209479177387814)
C1 = F(0.4886025119029199)
C20, C21, C22 = F(1.0925484305920792), F(0.31539156525252005), F(0.5462742152960396)
C30, C31, C32 = F(0.5900435899266435), F(2.890611442640554), F(0.4570457994644658)
C33, C34 = F(0.3731763325901154), F(1.445305721320277)


@helper
def _basis(x, y, z, degree, basis):  # type: ignore[no-untyped-def]
    """Real spherical harmonics of a unit vector into `basis` [16]."""
    basis[0] = C0
    if degree < 1:
        return
    basis[1] = -C1 * y
    basis[2] = C1 * z
    basis[3] = -C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = C20 * x * y
    basis[5] = -C20 * y * z
    basis[6] = C21 * (F(2) * zz - xx - yy)
    basis[7] = -C20 * x * z
    basis[8] = C22 * (xx - yy)
    if degree < 3:
        return
    basis[9] = -C30 * y * (F(3) * xx - yy)
    basis[10] = C31 * x * y * z
    basis[11] = -C32 * y * (F(4) * zz - xx - yy)
    basis[12] = C33 * z * (F(2) * zz - F(3) * xx - F(3) * yy)
    basis[13] = -C32 * x * (F(4) * zz - xx - yy)
    basis[14] = C34 * z * (xx - yy)
    basis[15] = -C30 * x * (xx - F(3) * yy)


@helper
def _basis_pullback(x, y, z, degree, g):  # type: ignore[no-untyped-def]
    """Gradient with respect to the vector, for a gradient `g` [16] of the basis."""
    dx, dy, dz = F(0), F(0), F(0)
    if degree >= 1:
        dx -= C1 * g[3]
        dy -= C1 * g[1]
        dz += C1 * g[2]
    if degree >= 2:
        two = F(2)
        dx += C20 * (y * g[4] - z * g[7]) + two * x * (C22 * g[8] - C21 * g[6])
        dy += C20 * (x * g[4] - z * g[5]) - two * y * (C22 * g[8] + C21 * g[6])
        dz += -C20 * (y * g[5] + x * g[7]) + F(4) * C21 * z * g[6]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        dx += -F(6) * C30 * x * y * g[9] + C31 * y * z * g[10] + F(2) * C32 * x * y * g[11]
        dx += -F(6) * C33 * x * z * g[12] - C32 * (F(4) * zz - F(3) * xx - yy) * g[13]
        dx += F(2) * C34 * x * z * g[14] - F(3) * C30 * (xx - yy) * g[15]
        dy += -F(3) * C30 * (xx - yy) * g[9] + C31 * x * z * g[10]
        dy += -C32 * (F(4) * zz - xx - F(3) * yy) * g[11] - F(6) * C33 * y * z * g[12]
        dy += F(2) * C32 * x * y * g[13] - F(2) * C34 * y * z * g[14] + F(6) * C30 * x * y * g[15]
        dz += C31 * x * y * g[10] - F(8) * C32 * y * z * g[11]
        dz += C33 * (F(6) * zz - F(3) * xx - F(3) * yy) * g[12] - F(8) * C32 * x * z * g[13]
        dz += C34 * (xx - yy) * g[14]
    return dx, dy, dz


@helper
def _features_of_chunk(  # type: ignore[no-untyped-def]
    chunk, packed, degree, centre, screen, next_pose, next_intrinsics, with_depth, with_flow, near,
    features,
):  # fmt: skip
    """One chunk of `features_forward`."""
    number = packed.shape[0]
    terms = (degree + 1) * (degree + 1)
    basis = np.zeros(16, np.float32)
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        if screen[i, 6] < F(0):
            continue
        column = 0
        if degree >= 0:
            x, y = packed[i, 0] - centre[0], packed[i, 1] - centre[1]
            z = packed[i, 2] - centre[2]
            length = F(1) / math.sqrt(x * x + y * y + z * z)
            _basis(x * length, y * length, z * length, degree, basis)
            red, green, blue = F(0.5), F(0.5), F(0.5)
            for k in range(terms):
                column = HARMONICS + 3 * k
                red += basis[k] * packed[i, column]
                green += basis[k] * packed[i, column + 1]
                blue += basis[k] * packed[i, column + 2]
            features[i, 0] = max(red, F(0))
            features[i, 1] = max(green, F(0))
            features[i, 2] = max(blue, F(0))
            column = 3
        if with_depth == 1:
            features[i, column] = screen[i, 8]
            column += 1
        if with_flow == 1:
            x, y, z = packed[i, 0], packed[i, 1], packed[i, 2]
            p = next_pose
            nx = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
            ny = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
            nz = max(p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3], F(near))
            u = next_intrinsics[0] * nx / nz + next_intrinsics[2]
            v = next_intrinsics[1] * ny / nz + next_intrinsics[3]
            features[i, column] = u - screen[i, 0]
            features[i, column + 1] = v - screen[i, 1]


@kernel(parallel=True)
def features_forward(  # type: ignore[no-untyped-def]
    packed: Floats, degree: int, centre: Floats, screen: Floats, next_pose: Floats,
    next_intrinsics: Floats, with_depth: int, with_flow: int, near: np.float32, features: Floats,
):  # fmt: skip
    """Colour, then depth, then flow of the visible Gaussians.

    Args:
        packed: [N, 11 + 3 K] scene.
        degree: of the harmonics, 0..3; K >= (degree + 1)^2. -1 for no colour.
        centre: [3] camera centre in the world.
        screen: [N, 16] projected Gaussians.
        next_pose, next_intrinsics: [3, 4] and [4], the camera that flow leads to.
        with_depth, with_flow: 1 to add a depth feature, then two flow features (px).
        near: depth at which the next camera's division is held.
        features: [N, >= 3 + with_depth + 2 with_flow] output; columns after those are left alone,
            and without colour there are three less.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _features_of_chunk(
            np.int64(chunk), packed, degree, centre, screen, next_pose, next_intrinsics, with_depth,
            with_flow, near, features,
        )  # fmt: skip


@helper
def _features_of_chunk_back(  # type: ignore[no-untyped-def]
    chunk, packed, degree, centre, pose, screen, next_pose, next_intrinsics, with_depth, with_flow,
    near, features, screen_gradient, gradient, camera_parts, next_parts,
):  # fmt: skip
    """One chunk of `features_backward`."""
    number = packed.shape[0]
    columns = packed.shape[1]
    terms = (degree + 1) * (degree + 1)
    basis = np.zeros(16, np.float32)
    d_basis = np.zeros(16, np.float32)
    for k in range(CAMERA_GRADIENTS):
        next_parts[chunk, k] = F(0)
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        for column in range(HARMONICS, columns):
            gradient[i, column] = F(0)
        if screen[i, 6] < F(0):
            continue
        column = 8
        if degree >= 0:
            x, y = packed[i, 0] - centre[0], packed[i, 1] - centre[1]
            z = packed[i, 2] - centre[2]
            length = F(1) / math.sqrt(x * x + y * y + z * z)
            x, y, z = x * length, y * length, z * length
            _basis(x, y, z, degree, basis)
            red = screen_gradient[i, 8] if features[i, 0] > F(0) else F(0)
            green = screen_gradient[i, 9] if features[i, 1] > F(0) else F(0)
            blue = screen_gradient[i, 10] if features[i, 2] > F(0) else F(0)
            for k in range(terms):
                column = HARMONICS + 3 * k
                gradient[i, column] = basis[k] * red
                gradient[i, column + 1] = basis[k] * green
                gradient[i, column + 2] = basis[k] * blue
                d_basis[k] = (
                    packed[i, column] * red
                    + packed[i, column + 1] * green
                    + packed[i, column + 2] * blue
                )
            if degree > 0:
                dx, dy, dz = _basis_pullback(x, y, z, degree, d_basis)
                along = dx * x + dy * y + dz * z
                dx, dy, dz = (
                    (dx - along * x) * length,
                    (dy - along * y) * length,
                    (dz - along * z) * length,
                )
                gradient[i, 0] += dx
                gradient[i, 1] += dy
                gradient[i, 2] += dz
                # the centre -R^T t moves by -R^T v under a twist (v, w)
                for k in range(3):
                    camera_parts[chunk, k] += pose[k, 0] * dx + pose[k, 1] * dy + pose[k, 2] * dz
            column = 11
        x, y, z = packed[i, 0], packed[i, 1], packed[i, 2]
        if with_depth == 1:
            dz = screen_gradient[i, column]
            column += 1
            for k in range(3):
                gradient[i, k] += pose[2, k] * dz
            camera_parts[chunk, 2] += dz
            px = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
            py = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
            camera_parts[chunk, 3] += py * dz
            camera_parts[chunk, 4] -= px * dz
        if with_flow == 1:
            p = next_pose
            nx = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
            ny = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
            nz = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            held = not nz > near
            iz = F(1) / max(nz, F(near))
            dx = screen_gradient[i, column] * next_intrinsics[0] * iz
            dy = screen_gradient[i, column + 1] * next_intrinsics[1] * iz
            dz = F(0) if held else -(dx * nx + dy * ny) * iz
            for k in range(3):
                gradient[i, k] += p[0, k] * dx + p[1, k] * dy + p[2, k] * dz
            next_parts[chunk, 0] += dx
            next_parts[chunk, 1] += dy
            next_parts[chunk, 2] += dz
            next_parts[chunk, 3] += ny * dz - nz * dy
            next_parts[chunk, 4] += nz * dx - nx * dz
            next_parts[chunk, 5] += nx * dy - ny * dx
            du, dv = screen_gradient[i, column], screen_gradient[i, column + 1]
            next_parts[chunk, 6] += du * nx * iz
            next_parts[chunk, 7] += dv * ny * iz
            next_parts[chunk, 8] += du
            next_parts[chunk, 9] += dv


@kernel(parallel=True)
def features_backward(  # type: ignore[no-untyped-def]
    packed: Floats, degree: int, centre: Floats, pose: Floats, screen: Floats, next_pose: Floats,
    next_intrinsics: Floats, with_depth: int, with_flow: int, near: np.float32, features: Floats,
    screen_gradient: Floats, gradient: Floats, camera_parts: Floats, next_parts: Floats,
):  # fmt: skip
    """Gradient of `features_forward`; runs after `project_backward`, to which it adds.

    The part of flow that comes from this camera's projection has been taken from the centre's
    gradient in `screen_gradient` beforehand.

    Args:
        screen_gradient: [N, 8 + F], features from column 8.
        gradient: [N, 11 + 3 K]; columns 0:3 are added to, 11: are set.
        camera_parts: [chunks, 10]; the twist is added to.
        next_parts: [chunks, 10] output, as `camera_parts`, of the next camera.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _features_of_chunk_back(
            np.int64(chunk), packed, degree, centre, pose, screen, next_pose, next_intrinsics,
            with_depth, with_flow, near, features, screen_gradient, gradient, camera_parts,
            next_parts,
        )  # fmt: skip
