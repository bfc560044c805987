"""What of a fitted scene is worth passing on, and how the viewer lays it out for the GPU."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians

#: Splats in a row of the texture; times 8 texels it is the 4096 that every WebGL2 device can do.
PER_ROW = 512


def coefficients(degree: int) -> int:
    """Number of spherical-harmonics coefficients after the constant."""
    return (degree + 1) ** 2 - 1


def texels(degree: int) -> int:
    """Texels (16 bytes) that a splat takes."""
    halfs_beyond = max(0, 3 * coefficients(degree) - 1)
    return 2 + -(-halfs_beyond // 8)


def visible(gaussians: Gaussians, alpha_min: float) -> npt.NDArray[np.bool_]:
    """[N] bool: finite, and opaque enough to be drawn at all."""
    finite = np.isfinite(gaussians.means).all(1) & np.isfinite(gaussians.log_scales).all(1)
    finite &= np.isfinite(gaussians.quats_wxyz).all(1) & np.isfinite(gaussians.sh).all((1, 2))
    return finite & (opacities(gaussians) >= alpha_min)


def opacity_bytes(gaussians: Gaussians) -> npt.NDArray[np.uint8]:
    """[N] opacities of 0..255 as files of bytes have them: 1 to 254.

    Readers turn them into logits, and those of 0 and 1 are infinite.
    """
    levels: npt.NDArray[np.uint8] = np.clip(np.rint(opacities(gaussians) * 255), 1, 254).astype(
        np.uint8
    )
    return levels


def opacities(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """[N] float64 in 0..1."""
    return 1.0 / (1.0 + np.exp(-gaussians.logit_opacities.astype(np.float64)))


def smallest_three(
    quats_wxyz: npt.NDArray[np.floating],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Quaternions [N, 4] as which component is the largest [N], and the others [N, 3] in order.

    The largest is positive and follows from the others, which are within +-sqrt 0.5.
    """
    quats = np.asarray(quats_wxyz, np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]  # [N, 3]
    return largest, quats[rows[:, None], others]
