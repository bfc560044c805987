"""Residuals of one view's pointmaps and what Gauss-Newton needs of them (numba).

A pixel of view v with depth d and ray k is the world point X = R_v^T (d k - t_v); pair e sees it at
Y = a_e R_e X + b_e in its own frame; the residual is (Y - P) / |P|, with P what the pair says. A
residual in the pair's frame compares data with a prediction. Taken in the world (as DUSt3R does) it
would be scaled by an unknown, and shrink with it.
"""

from __future__ import annotations

import numpy as np

from pipeline.kernels import kernel

#: Unknowns of a camera: rotation, translation, log focal length.
CAMERA = 7
#: Unknowns of a pair: rotation, translation, log scale.
PAIR = 7


@kernel()
def linearise_view(  # type: ignore[no-untyped-def]
    pixels, log_depth, rotation, translation, focal, pair_rotation, pair_scale, pair_shift,
    points, weight, inverse_distance, delta,
    matrix, gradient, cross, depth_curvature, depth_gradient, sizes,
):  # fmt: skip
    """Accumulate the normal equations of one view.

    Args:
        pixels: [M, 2] float64 from the principal point.
        log_depth: [M].
        rotation, translation, focal: [3, 3], [3], [2] of the camera.
        pair_rotation, pair_scale, pair_shift: [N, 3, 3], [N], [N, 3] pair_from_world.
        points: [N, M, 3] what the pairs say; weight, inverse_distance: [N, M].
        delta: residual from which Huber's loss is linear.
        matrix, gradient: out, [7 + 7 N, 7 + 7 N] (blocks of the camera and of each pair with the
            camera and itself) and [7 + 7 N]; zero on entry.
        cross: out, [M, 7 + 7 N] derivatives by depth and the rest; zero on entry.
        depth_curvature, depth_gradient: out, [M]; zero on entry.
        sizes: out, [N, M] lengths of the residuals.

    Returns:
        Huber's loss, summed.
    """
    count = points.shape[0]
    loss = 0.0
    ray = np.empty(3)
    jx = np.empty((3, 8))  # X by camera (7) and log depth
    jr = np.empty((3, 15))  # residual by camera, pair and log depth
    centred = np.empty(3)
    world = np.empty(3)
    turned = np.empty(3)
    residual = np.empty(3)
    for m in range(pixels.shape[0]):
        depth = np.exp(log_depth[m])
        ray[0] = pixels[m, 0] / focal[0]
        ray[1] = pixels[m, 1] / focal[1]
        ray[2] = 1.0
        for r in range(3):
            centred[r] = depth * ray[r] - translation[r]
        for r in range(3):
            a, b, c = rotation[0, r], rotation[1, r], rotation[2, r]
            world[r] = a * centred[0] + b * centred[1] + c * centred[2]
            # R^T [c]_x, -R^T, focal length, log depth
            jx[r, 0] = b * centred[2] - c * centred[1]
            jx[r, 1] = c * centred[0] - a * centred[2]
            jx[r, 2] = a * centred[1] - b * centred[0]
            jx[r, 3], jx[r, 4], jx[r, 5] = -a, -b, -c
            jx[r, 6] = -depth * (a * ray[0] + b * ray[1])
            jx[r, 7] = depth * (a * ray[0] + b * ray[1] + c * ray[2])
        for n in range(count):
            if weight[n, m] <= 0:
                continue
            scale, near = pair_scale[n], inverse_distance[n, m]
            size = 0.0
            for r in range(3):
                turned[r] = scale * (
                    pair_rotation[n, r, 0] * world[0]
                    + pair_rotation[n, r, 1] * world[1]
                    + pair_rotation[n, r, 2] * world[2]
                )
                residual[r] = near * (turned[r] + pair_shift[n, r] - points[n, m, r])
                size += residual[r] * residual[r]
            size = np.sqrt(size)
            sizes[n, m] = size
            if size < delta:
                w = weight[n, m] / delta
                loss += weight[n, m] * 0.5 * (size * size / delta + delta)
            else:
                w = weight[n, m] / size
                loss += weight[n, m] * size
            for r in range(3):
                for c in range(8):
                    value = (
                        pair_rotation[n, r, 0] * jx[0, c]
                        + pair_rotation[n, r, 1] * jx[1, c]
                        + pair_rotation[n, r, 2] * jx[2, c]
                    )
                    jr[r, c if c < 7 else 14] = near * scale * value
                for c in range(3):
                    jr[r, 7 + c] = 0.0
                    jr[r, 10 + c] = 0.0
                jr[r, 10 + r] = near
                jr[r, 13] = near * turned[r]
            # -[turned]_x
            jr[0, 8] = near * turned[2]
            jr[0, 9] = -near * turned[1]
            jr[1, 7] = -near * turned[2]
            jr[1, 9] = near * turned[0]
            jr[2, 7] = near * turned[1]
            jr[2, 8] = -near * turned[0]
            first = 7 + 7 * n
            d0, d1, d2 = w * jr[0, 14], w * jr[1, 14], w * jr[2, 14]
            depth_curvature[m] += d0 * jr[0, 14] + d1 * jr[1, 14] + d2 * jr[2, 14]
            depth_gradient[m] += d0 * residual[0] + d1 * residual[1] + d2 * residual[2]
            for c in range(14):
                k = c if c < 7 else first + c - 7
                x, y, z = jr[0, c], jr[1, c], jr[2, c]
                cross[m, k] += d0 * x + d1 * y + d2 * z
                x, y, z = w * x, w * y, w * z
                gradient[k] += x * residual[0] + y * residual[1] + z * residual[2]
                for d in range(c + 1):
                    value = x * jr[0, d] + y * jr[1, d] + z * jr[2, d]
                    matrix[k, d if d < 7 else first + d - 7] += value
    return loss
