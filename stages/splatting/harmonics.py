"""Spherical harmonics as 3DGS has them, in numpy: what the kernels compute for each Gaussian."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: what 3DGS adds to them for a colour
OFFSET = 0.5


def harmonics(directions: npt.NDArray[np.floating]) -> Array:
    """The 16 real spherical harmonics of 3DGS at unit directions [M, 3] -> [M, 16]."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            np.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
            1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        axis=1,
    )  # fmt: skip


def seen_from(centre: npt.NDArray[np.floating], positions: npt.NDArray[np.floating]) -> Array:
    """The 16 harmonics of Gaussians at positions [N, 3], as a camera at `centre` [3] sees them."""
    rays = np.asarray(positions, np.float64) - centre
    return harmonics(rays / np.linalg.norm(rays, axis=1, keepdims=True))
