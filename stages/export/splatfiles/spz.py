"""Niantic's `.spz`, version 2: a gzipped file of about a tenth of the `.ply`.

Source: https://github.com/nianticlabs/spz (load-spz.cc; MIT). Layout after decompression, little-
endian: header of 16 bytes (magic "NGSP", version, count: uint32; degree, fractional bits, flags, 0:
uint8), then all positions (3 x 24 bits, fixed point), all opacities (uint8), colours (3 x uint8),
scales (3 x uint8, logarithmic), rotations (3 x uint8: x, y, z of the quaternion with w >= 0), and
harmonics (uint8, coefficient by coefficient, its three colours beside each other). Axes are x
right, y up, z back (towards the viewer), as the format declares.

Version 2 and not 3, which stores rotations finer: it is the one that every reader knows.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians
from stages.export.splats import coefficients, opacity_bytes

MAGIC, VERSION = 0x5053474E, 2
#: Colour bytes: (f_dc * this + .5) * 255.
COLOR_SCALE = 0.15
#: Bits behind the point of a position at most, and what 24 bits with a sign hold.
MOST_BITS, POSITION_LIMIT = 20, (1 << 23) - 1
#: Harmonics keep 6 bits in the first degree and 5 above, one more than the format's own writer: a
#: tenth larger, and .9 dB nearer to the photographs of the sample scene. All 8 are worth .2 dB.
FIRST_BITS, FURTHER_BITS = 6, 5
#: Fast rather than small: level 6 takes half as long again for 3 % less.
LEVEL = 3


def spz_bytes(gaussians: Gaussians, degree: int) -> bytes:
    """The Gaussians as an `.spz` file.

    Args:
        gaussians: N finite ones; x right, y up, z towards the viewer.
        degree: of the harmonics to keep, 0..3.
    """
    count = len(gaussians)
    farthest = max(float(np.abs(gaussians.means).max(initial=0)), 1e-12)
    bits = int(np.clip(np.floor(np.log2(POSITION_LIMIT / farthest)), 0, MOST_BITS))
    fixed = np.rint(gaussians.means.astype(np.float64) * (1 << bits))
    fixed = np.clip(fixed, -POSITION_LIMIT, POSITION_LIMIT).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(count, 3, 4)[:, :, :3]
    quats = gaussians.quats_wxyz.astype(np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    quats *= np.where(quats[:, :1] < 0, -1.0, 1.0)
    parts = [
        positions,
        opacity_bytes(gaussians),
        _bytes((gaussians.sh[:, 0] * COLOR_SCALE + 0.5) * 255),
        _bytes((gaussians.log_scales + 10) * 16),
        _bytes((quats[:, 1:] + 1) * 127.5),
        _harmonics(gaussians.sh[:, 1 : 1 + coefficients(degree)]),
    ]
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, count, degree, bits, 0, 0)
    body = header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    # A gzip stream without a time and a name: the same scene gives the same bytes.
    packer = zlib.compressobj(LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    return packer.compress(body) + packer.flush()


def _bytes(values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _harmonics(sh: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """[N, K, 3] coefficients as bytes, rounded to the middle of their buckets."""
    steps = np.full(sh.shape[1], 1 << (8 - FURTHER_BITS), np.int32)
    steps[:3] = 1 << (8 - FIRST_BITS)
    step = steps[None, :, None]
    values = np.rint(sh * 128).astype(np.int32) + 128
    return np.clip((values + step // 2) // step * step, 0, 255).astype(np.uint8)
