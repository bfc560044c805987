"""PlayCanvas's compressed `.ply`: chunks of 256 Gaussians, each within its own bounds.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/ and the writer
of @playcanvas/splat-transform (MIT). 16 bytes a Gaussian, 72 a chunk, and a byte a harmonic.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import (
    COMPRESSED_BOUNDS,
    COMPRESSED_CHUNK,
    COMPRESSED_HARMONIC_SPAN,
    COMPRESSED_WORDS,
    Gaussians,
    ply_comment,
)
from stages.export.splats import coefficients, opacity_bytes, smallest_three
from stages.splatting.rendering import CONSTANT_HARMONIC

#: Logarithms of sizes beyond this are cut.
MOST_LOG_SCALE = 20.0

CHUNK_PROPERTIES = [
    f"{side}_{name}" for group in COMPRESSED_BOUNDS for side in ("min", "max") for name in group
]


def compressed_ply_bytes(gaussians: Gaussians, degree: int, comments: Iterable[str] = ()) -> bytes:
    """The Gaussians as a compressed `.ply`.

    Args:
        gaussians: N finite ones, best in an order in which neighbours lie beside each other.
        degree: of the harmonics to keep, 0..3.
        comments: lines for the header.
    """
    count = len(gaussians)
    positions, low_p, high_p = _within(gaussians.means)
    sizes = np.clip(gaussians.log_scales, -MOST_LOG_SCALE, MOST_LOG_SCALE)
    scales, low_s, high_s = _within(sizes)
    colors, low_c, high_c = _within(gaussians.sh[:, 0] * np.float32(CONSTANT_HARMONIC) + 0.5)
    alpha = opacity_bytes(gaussians)[:, None] / 255
    words = np.stack(
        [
            _packed(positions, (11, 10, 11)),
            _rotations(gaussians.quats_wxyz),
            _packed(scales, (11, 10, 11)),
            _packed(np.concatenate([colors, alpha], 1), (8, 8, 8, 8)),
        ],
        axis=1,
    ).astype("<u4")
    bounds = np.concatenate([low_p, high_p, low_s, high_s, low_c, high_c], 1).astype("<f4")
    further = gaussians.sh[:, 1 : 1 + coefficients(degree)].transpose(0, 2, 1)
    rest = further.reshape(count, 3 * coefficients(degree))
    shares = np.trunc((rest.astype(np.float64) / COMPRESSED_HARMONIC_SPAN + 0.5) * 256)
    header = ["ply", "format binary_little_endian 1.0", *map(ply_comment, comments)]
    header += [f"element chunk {len(bounds)}", *(f"property float {n}" for n in CHUNK_PROPERTIES)]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in COMPRESSED_WORDS)]
    if degree:
        header += [f"element sh {count}"]
        header += [f"property uchar f_rest_{k}" for k in range(rest.shape[1])]
    header += ["end_header", ""]
    return (
        "\n".join(header).encode("ascii") + bounds.tobytes() + words.tobytes()
        + np.clip(shares, 0, 255).astype(np.uint8).tobytes()
    )  # fmt: skip


def _within(
    values: npt.NDArray[np.floating],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Values [N, C] as shares 0..1 of the bounds of their chunks, and these bounds [chunks, C]."""
    starts = np.arange(0, len(values), COMPRESSED_CHUNK)
    numbers = np.asarray(values, np.float64)
    if not len(starts):
        empty = np.zeros((0, numbers.shape[1]))
        return numbers, empty, empty
    low, high = np.minimum.reduceat(numbers, starts), np.maximum.reduceat(numbers, starts)
    chunk = np.arange(len(values)) // COMPRESSED_CHUNK
    span = (high - low)[chunk]
    flat = span < 1e-5  # readers multiply by the span: nothing is lost
    return np.where(flat, 0, (numbers - low[chunk]) / np.where(flat, 1, span)), low, high


def _packed(shares: npt.NDArray[np.floating], bits: tuple[int, ...]) -> npt.NDArray[np.uint32]:
    """Shares 0..1 [N, C] in one word each, the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in enumerate(bits):
        most = (1 << width) - 1
        level = np.clip(np.floor(shares[:, column] * most + 0.5), 0, most).astype(np.uint32)
        word = word << np.uint32(width) | level
    return word


def _rotations(quats_wxyz: npt.NDArray[np.floating]) -> npt.NDArray[np.uint32]:
    """[N, 4] quaternions -> which component is the largest (2 bits), the others (10 bits each)."""
    largest, others = smallest_three(quats_wxyz)
    shares = others * np.sqrt(0.5) + 0.5
    return largest.astype(np.uint32) << np.uint32(30) | _packed(shares, (10, 10, 10))
