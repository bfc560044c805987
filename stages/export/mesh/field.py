"""A signed distance field around a surface: fused from depth maps, and smoothed.

The field is kept where the surface may be, in blocks of 8 x 8 x 8 voxels. Every block is worked on
by itself, so that the number of threads changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import each, helper, kernel

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]
F = np.float32

#: Voxels along the edge of a block, and the truncation: a block around the surface has it within.
BLOCK = 8
TRUNCATION = 5
#: Bits of a block's number along one axis.
_BITS = 21
#: A block (number 13) and its 26 neighbours.
_AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
#: Vertices that get their colour at a time.
_CHUNK = 1024
#: The blur along one axis, of variance 1/2, and its reach.
_BLUR = np.array([1, 2, 1], np.float32) / 4
_REACH = 1


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps of any sizes as kernels take them.

    Attributes:
        rotations, translations: [K, 3, 3] and [K, 3] of cam_from_world.
        lenses: [K, 4] fx, fy, cx, cy.
        sizes: [K, 3] width, height, and where the view begins in the arrays below.
        depths: [P] float32 z of all pixels, row by row; 0: unknown.
        colors: [P, 3] uint8 RGB.
    """

    rotations: Array
    translations: Array
    lenses: Array
    sizes: Ints
    depths: Floats
    colors: Bytes

    @classmethod
    def of(cls, cameras: Sequence[Camera], images: Sequence[Bytes], depths: Sequence[Floats]):  # type: ignore[no-untyped-def]
        """From K >= 1 cameras, images [H, W, 3] and depth maps [H, W]."""
        starts = np.cumsum([0] + [depth.size for depth in depths])[:-1]
        sizes = [(c.width, c.height, start) for c, start in zip(cameras, starts, strict=True)]
        return cls(
            np.array([camera.rotation for camera in cameras], np.float64),
            np.array([camera.translation for camera in cameras], np.float64),
            np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float64),
            np.array(sizes, np.int64),
            np.concatenate([np.asarray(depth, np.float32).ravel() for depth in depths]),
            np.concatenate([image.reshape(-1, 3) for image in images]),
        )


@dataclass(frozen=True)
class Field:
    """A truncated signed distance field in blocks.

    Attributes:
        voxel: distance of its points, world units; point (i, j, k) lies at `voxel` times that.
        blocks: [B, 3] of each block's first point, in blocks.
        neighbours: [B, 27] rows of the blocks around each one, -1 where there is none.
        values: [B, 8, 8, 8] float32 in -1..1 of the truncation, positive outside.
        weights: [B, 8, 8, 8] float32, depth maps that have a say.
    """

    voxel: float
    blocks: Ints
    neighbours: Numbers
    values: Floats
    weights: Floats

    def smoothed(self) -> Field:
        """The field without its noise from voxel to voxel, and carried on by 2 into the unknown.

        2 B - B B for a blur B of variance 1/2 voxel^2 in which points count by their weight
        (Tukey's twicing): unlike B alone it does not draw edges and cusps in.
        """
        once = self._blurred()
        twice = once._blurred()
        known = once.weights > 0
        values = np.where(known, 2 * once.values - twice.values, twice.values)
        return replace(twice, values=values)

    def _blurred(self) -> Field:
        values, weights = np.empty_like(self.values), np.empty_like(self.weights)
        each(
            _blur_block, len(self.blocks), self.neighbours, self.values, self.weights, _BLUR,
            values, weights,
        )  # fmt: skip
        return replace(self, values=values, weights=weights)


def _keys(blocks: Ints) -> Ints:
    """[N] a number for each block [N, 3], in lexicographic order."""
    shifted = blocks + (1 << (_BITS - 1))
    return shifted[:, 0] << 2 * _BITS | shifted[:, 1] << _BITS | shifted[:, 2]


def _blocks(keys: Ints) -> Ints:
    parts = [keys >> 2 * _BITS, keys >> _BITS, keys]
    return np.stack(parts, 1) % (1 << _BITS) - (1 << (_BITS - 1))


def _grown(keys: Ints) -> Ints:
    """The blocks and their neighbours."""
    return np.unique(_keys((_blocks(keys)[:, None] + _AROUND).reshape(-1, 3)))


def _touched(points: npt.NDArray[np.floating], edge: float) -> Ints:
    """Numbers of the blocks of a size that points [N, 3] lie in."""
    limit = (1 << (_BITS - 1)) - 2
    cubes = np.floor(np.asarray(points, np.float64) / edge)
    return np.unique(_keys(cubes[(np.abs(cubes) < limit).all(1)].astype(np.int64)))


def around_blocks(blocks: Ints) -> Numbers:
    """[B, 27] rows of the blocks around each of [B, 3] in lexicographic order; -1: none there."""
    keys = _keys(blocks)
    around = _keys((blocks[:, None] + _AROUND).reshape(-1, 3))
    place = np.minimum(np.searchsorted(keys, around), max(len(keys) - 1, 0))
    there = keys[place] == around if len(keys) else np.zeros(0, bool)
    return np.where(there, place, -1).reshape(-1, len(_AROUND)).astype(np.int32)


def fuse(
    cameras: Sequence[Camera], images: Sequence[Bytes], depths: Sequence[Floats], voxel: float,
    support: npt.NDArray[np.floating], reach: float,
) -> tuple[Field, DepthMaps]:  # fmt: skip
    """Fuse depth maps into a truncated signed distance field (Curless and Levoy 1996).

    Args:
        cameras: K of them. images: K times RGB [H, W, 3]. depths: K times [H, W] (z; 0: unknown).
        voxel: distance of the field's points, world units.
        support: [N, 3] points that the surface is near to.
        reach: how near; the field is made there alone, world units.
    """
    edge = BLOCK * voxel
    seen = [_touched(np.zeros((0, 3)), edge)]
    for camera, depth in zip(cameras, depths, strict=True):
        if not (depth > 0).any():
            continue
        # about a voxel from pixel to pixel
        step = max(1, int(voxel * camera.fx / np.median(depth[depth > 0])))
        some = depth[step // 2 :: step, step // 2 :: step]
        fewer = camera.resized(some.shape[1], some.shape[0])
        seen.append(_touched(fewer.unproject(some)[some > 0], edge))
    keys = _grown(np.unique(np.concatenate(seen)))
    near = _touched(support, edge)
    for _ in range(int(np.ceil(reach / edge))):
        near = _grown(near)
    keys = np.intersect1d(keys, near, assume_unique=True)
    blocks = _blocks(keys)
    neighbours = around_blocks(blocks)
    maps = DepthMaps.of(cameras, images, depths)
    values = np.zeros((len(blocks), BLOCK, BLOCK, BLOCK), np.float32)
    weights = np.zeros_like(values)
    each(
        _integrate_block, len(blocks), blocks, voxel, maps.rotations, maps.translations,
        maps.lenses, maps.sizes, maps.depths, values, weights,
    )  # fmt: skip
    return Field(voxel, blocks, neighbours, values, weights), maps


@kernel(nogil=True)
def _integrate_block(  # type: ignore[no-untyped-def]
    block, blocks, voxel, rotations, translations, lenses, sizes, depths, values, weights
):  # fmt: skip
    """One block of `fuse`: the mean of what the depth maps say of each of its points."""
    x0, y0, z0 = (
        blocks[block, 0] * BLOCK * voxel, blocks[block, 1] * BLOCK * voxel,
        blocks[block, 2] * BLOCK * voxel,
    )  # fmt: skip
    truncation = TRUNCATION * voxel
    for view in range(len(lenses)):
        r, t = rotations[view], translations[view]
        fx, fy, cx, cy = lenses[view]
        width, height, start = sizes[view]
        for i in range(BLOCK):
            for j in range(BLOCK):
                x, y = x0 + i * voxel, y0 + j * voxel
                ax = r[0, 0] * x + r[0, 1] * y + t[0]
                ay = r[1, 0] * x + r[1, 1] * y + t[1]
                az = r[2, 0] * x + r[2, 1] * y + t[2]
                for k in range(BLOCK):
                    z = z0 + k * voxel
                    depth = az + r[2, 2] * z
                    if depth <= 0:
                        continue
                    column = np.floor(fx * (ax + r[0, 2] * z) / depth + cx)
                    row = np.floor(fy * (ay + r[1, 2] * z) / depth + cy)
                    if not (0 <= column < width and 0 <= row < height):
                        continue
                    surface = depths[start + np.int64(row) * width + np.int64(column)]
                    if surface <= 0 or surface - depth < -truncation:
                        continue
                    values[block, i, j, k] += F(min((surface - depth) / truncation, 1.0))
                    weights[block, i, j, k] += F(1)
    for i in range(BLOCK):
        for j in range(BLOCK):
            for k in range(BLOCK):
                if weights[block, i, j, k] > 0:
                    values[block, i, j, k] /= weights[block, i, j, k]


@helper
def block_at(neighbours, block, i, j, k):  # type: ignore[no-untyped-def]
    """Row of the block that point (i, j, k) of a block lies in, -8 <= i, j, k < 16; or -1."""
    around = 9 * ((i + BLOCK) // BLOCK) + 3 * ((j + BLOCK) // BLOCK) + (k + BLOCK) // BLOCK
    return neighbours[block, around]


@kernel(nogil=True)
def _blur_block(block, neighbours, values, weights, taps, out_values, out_weights):  # type: ignore[no-untyped-def]
    """One block of a blur."""
    side = BLOCK + 2 * _REACH
    sums = np.zeros((2, side, side, side), np.float32)
    for i in range(side):
        for j in range(side):
            for k in range(side):
                a, b, c = i - _REACH, j - _REACH, k - _REACH
                there = block_at(neighbours, block, a, b, c)
                if there >= 0:
                    weight = weights[there, a % BLOCK, b % BLOCK, c % BLOCK]
                    sums[0, i, j, k] = weight * values[there, a % BLOCK, b % BLOCK, c % BLOCK]
                    sums[1, i, j, k] = weight
    for part in range(2):
        total = sums[part]
        for i in range(side):
            for j in range(side):
                for k in range(BLOCK):
                    value = F(0)
                    for tap in range(len(taps)):
                        value += taps[tap] * total[i, j, k + tap]
                    total[i, j, k] = value
        for i in range(side):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    value = F(0)
                    for tap in range(len(taps)):
                        value += taps[tap] * total[i, j + tap, k]
                    total[i, j, k] = value
        for i in range(BLOCK):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    value = F(0)
                    for tap in range(len(taps)):
                        value += taps[tap] * total[i + tap, j, k]
                    total[i, j, k] = value
    for i in range(BLOCK):
        for j in range(BLOCK):
            for k in range(BLOCK):
                weight = sums[1, i, j, k]
                out_weights[block, i, j, k] = weight
                out_values[block, i, j, k] = sums[0, i, j, k] / weight if weight > 0 else F(0)


def colors_of(vertices: Array, maps: DepthMaps, within: float) -> Array:
    """[V, 3] mean colour, 0..1, of vertices [V, 3] in the views whose depth agrees `within`.

    A vertex that none sees takes the colour of the nearest that is seen.
    """
    from scipy.spatial import cKDTree

    colors = np.empty((len(vertices), 3), np.float32)
    each(
        _color_chunk, -(-len(vertices) // _CHUNK), vertices, within, maps.rotations,
        maps.translations, maps.lenses, maps.sizes, maps.depths, maps.colors, colors,
    )  # fmt: skip
    unseen = np.isnan(colors[:, 0])
    if unseen.any() and not unseen.all():
        nearest = cKDTree(vertices[~unseen]).query(vertices[unseen])[1]
        colors[unseen] = colors[~unseen][nearest]
    return np.nan_to_num(colors).astype(np.float64) / 255


@kernel(nogil=True)
def _color_chunk(  # type: ignore[no-untyped-def]
    chunk, vertices, within, rotations, translations, lenses, sizes, depths, colors, out
):  # fmt: skip
    """Some vertices of `colors_of`; not a number where no view sees one."""
    for vertex in range(chunk * _CHUNK, min(len(vertices), (chunk + 1) * _CHUNK)):
        x, y, z = vertices[vertex]
        red, green, blue, count = F(0), F(0), F(0), F(0)
        for view in range(len(lenses)):
            r, t = rotations[view], translations[view]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            if depth <= 0:
                continue
            fx, fy, cx, cy = lenses[view]
            width, height, start = sizes[view]
            across = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
            down = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
            column = np.floor(fx * across / depth + cx)
            row = np.floor(fy * down / depth + cy)
            if not (0 <= column < width and 0 <= row < height):
                continue
            pixel = start + np.int64(row) * width + np.int64(column)
            if depths[pixel] > 0 and abs(depths[pixel] - depth) < within:
                red += F(colors[pixel, 0])
                green += F(colors[pixel, 1])
                blue += F(colors[pixel, 2])
                count += F(1)
        if count > 0:
            out[vertex, 0], out[vertex, 1], out[vertex, 2] = (
                red / count,
                green / count,
                blue / count,
            )
        else:
            out[vertex, :] = F(np.nan)
