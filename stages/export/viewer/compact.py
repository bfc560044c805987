"""The small form in which the viewer page carries arrays: planes of bytes, deflated, in base64.

An array [N, C] of numbers becomes C columns. A column is rounded to `bits` bits between its least
and its largest value; columns of more than 8 bits come as two planes, the low bytes first. Columns
that change little from row to row (`delta`) hold differences, zigzag coded. `decode.js` reads it.

Gaussians stand in Morton order, so that neighbours in the file are neighbours in the scene:

============ ======= ===== =======================================================================
array        columns bits  content
============ ======= ===== =======================================================================
means        3       16    sign(v) log(1 + |v| / reach), v from the middle of the scene; delta
turns        4       8     the bytes of the quaternion: 2 bits which component is the largest, 3 x
                           10 bits of the others (`packed_quaternions`)
scales       3       8     logarithms
opacities    1       8     0..1
colours      3       10    f_dc, or the albedo as .5 + C0 f_dc where the scene has a light
normals      2       10    octahedral, where the scene has a light
harmonics    3 K     8     the coefficients after the constant, where it has none
flags        1       8     bits 0-1: 1 upper jaw, 2 lower jaw; bits 2-7: photographs that saw it
============ ======= ===== =======================================================================
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians
from stages.export.splatfiles.order import morton_order
from stages.export.splats import coefficients, opacities, smallest_three

Floats = npt.NDArray[np.floating]
Integers = npt.NDArray[np.integer]
#: Most photographs that a flag can count.
MOST_SEEN = 63
#: Logarithms of sizes beyond these are no sizes.
_LEAST_SCALE, _LARGEST_SCALE = -30.0, 30.0


class Pack:
    """Collects columns; `described` says what they are, `text` is what they hold."""

    def __init__(self) -> None:
        self._planes: list[bytes] = []
        self.described: dict[str, dict[str, Any]] = {}

    def add(self, name: str, values: Floats, bits: int, delta: bool = False) -> None:
        """Round the columns of [N, C] numbers to `bits` (8..16) bits each."""
        low = values.min(0) if len(values) else np.zeros(values.shape[1])
        high = values.max(0) if len(values) else np.ones(values.shape[1])
        step = np.where(high > low, (high - low) / (2**bits - 1), 1.0)
        levels = np.rint((values - low) / step).astype(np.int64)
        self.add_levels(name, levels, bits, delta)
        self.described[name] |= {"low": low.tolist(), "step": step.tolist()}

    def add_levels(self, name: str, levels: Integers, bits: int, delta: bool = False) -> None:
        """Take over [N, C] whole numbers of `bits` (8..16) bits."""
        levels = np.asarray(levels, np.int64)
        if delta:
            steps = np.diff(levels, axis=0, prepend=0)
            half = 1 << (bits - 1)
            steps = (steps + half) % (1 << bits) - half  # differences wrap round
            levels = np.where(steps < 0, -2 * steps - 1, 2 * steps)
        for column in levels.T:
            self._planes.append((column & 255).astype(np.uint8).tobytes())
            if bits > 8:
                self._planes.append((column >> 8).astype(np.uint8).tobytes())
        self.described[name] = {
            "rows": len(levels), "columns": levels.shape[1], "bits": bits, "delta": delta,
        }  # fmt: skip

    def text(self) -> str:
        """All columns in the order of their coming: deflated (RFC 1951), in base64."""
        squeeze = zlib.compressobj(6, zlib.DEFLATED, -15)
        data = squeeze.compress(b"".join(self._planes)) + squeeze.flush()
        return base64.b64encode(data).decode("ascii")


def packed_quaternions(quats_wxyz: Floats) -> npt.NDArray[np.uint32]:
    """[N, 4] quaternions -> [N] uint32: bits 30-31 which component is the largest (made positive
    and left out), 0-9, 10-19, 20-29 the others in order, from -1/sqrt 2 to 1/sqrt 2."""
    largest, others = smallest_three(quats_wxyz)
    share = (others * np.sqrt(2) + 1) / 2
    levels = np.clip(np.rint(share * 1023), 0, 1023).astype(np.uint32)
    packed = levels[:, 0] | levels[:, 1] << np.uint32(10) | levels[:, 2] << np.uint32(20)
    return packed | largest.astype(np.uint32) << np.uint32(30)


def octahedral(directions: Floats) -> npt.NDArray[np.float64]:
    """[N, 3] directions -> [N, 2] in -1..1 (Meyer et al. 2010)."""
    d = directions / np.maximum(np.abs(directions).sum(1, keepdims=True), 1e-12)
    folded = (1 - np.abs(d[:, [1, 0]])) * np.where(d[:, :2] >= 0, 1.0, -1.0)
    return np.asarray(np.where(d[:, 2:] >= 0, d[:, :2], folded), np.float64)


def add_gaussians(
    pack: Pack, gaussians: Gaussians, degree: int, flags: Integers, middle: Floats, reach: float
) -> None:
    """Add Gaussians as the module's table says.

    Args:
        gaussians: N Gaussians, all finite.
        degree: of the harmonics to carry, 0..3; those with a light carry albedo and normal instead.
        flags: [N] see the table.
        middle, reach: [3] and a length: places are finest within `reach` of the middle.
    """
    order = morton_order(gaussians.means)
    means = (gaussians.means[order] - middle) / reach
    pack.add("means", np.sign(means) * np.log1p(np.abs(means)), 16, delta=True)
    turns = packed_quaternions(gaussians.quats_wxyz[order])
    pack.add_levels("turns", turns[:, None] >> np.array([0, 8, 16, 24]) & 255, 8)
    scales = np.clip(gaussians.log_scales[order], _LEAST_SCALE, _LARGEST_SCALE)
    pack.add("scales", scales, 8)
    pack.add("opacities", opacities(gaussians)[order, None], 8)
    if gaussians.light is not None:
        pack.add("colours", gaussians.light.albedo[order], 10)
        pack.add("normals", octahedral(gaussians.light.normals[order]), 10)
    else:
        pack.add("colours", gaussians.sh[order, 0], 10)
        if degree:
            rest = gaussians.sh[order, 1 : 1 + coefficients(degree)]
            pack.add("harmonics", rest.reshape(len(rest), -1), 8)
    pack.add_levels("flags", np.asarray(flags)[order, None], 8)


def add_mesh(pack: Pack, vertices: Floats, faces: Integers, jaws: Integers) -> None:
    """Add a triangle mesh of at most 65,536 vertices.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        jaws: [V] 0 neither, 1 upper, 2 lower.
    """
    order = morton_order(vertices)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    turned = place[faces]
    start = turned.argmin(1)  # the smallest first, which side is outside stays
    turned = np.take_along_axis(turned, (start[:, None] + np.arange(3)) % 3, 1)
    turned = turned[np.argsort(turned[:, 0], kind="stable")]
    turned[:, 1:] -= turned[:, :1]
    pack.add("mesh_vertices", vertices[order], 14, delta=True)
    pack.add_levels("mesh_jaws", jaws[order, None], 8)
    pack.add_levels("mesh_first", turned[:, :1], 16, delta=True)
    pack.add_levels("mesh_others", turned[:, 1:], 16)
