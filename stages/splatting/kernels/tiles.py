"""Which Gaussian touches which tile of the image, front to back, as numba kernels."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.lanes import blocks

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32

#: Tiles are TILE x TILE pixels.
TILE = blocks.TILE
CHUNK = 256
_DIGIT_BITS = 11


# No fastmath here: `count_tiles` and `list_tiles` must come to the same answer.
@helper
def _touches(dx0, dx1, dy0, dy1, a, b, c, reach):  # type: ignore[no-untyped-def]
    """Does the ellipse a x^2 + 2 b x y + c y^2 <= reach meet a rectangle (relative to its centre)?

    The minimum over a rectangle without the centre lies on an edge that faces the centre.
    """
    inside_x = dx0 <= F(0) and dx1 >= F(0)
    inside_y = dy0 <= F(0) and dy1 >= F(0)
    if inside_x and inside_y:
        return True
    if not inside_x:
        x = dx0 if dx0 > F(0) else dx1
        y = min(dy1, max(dy0, -b * x / c))
        if a * x * x + F(2) * b * x * y + c * y * y <= reach:
            return True
    if not inside_y:
        y = dy0 if dy0 > F(0) else dy1
        x = min(dx1, max(dx0, -b * y / a))
        if a * x * x + F(2) * b * x * y + c * y * y <= reach:
            return True
    return False


@helper
def _count_chunk(chunk, screen, tiles_x, tiles_y, alpha_cut, bounds, count):  # type: ignore[no-untyped-def]
    """One chunk of `count_tiles`."""
    number = screen.shape[0]
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        count[i] = 0
        if screen[i, 6] < F(0):
            continue
        u, v, half_width, half_height = screen[i, 0], screen[i, 1], screen[i, 6], screen[i, 7]
        # pixel centres within the ellipse's box; clipped first, so that no cast overflows
        last_x, last_y = F(tiles_x * TILE - 1), F(tiles_y * TILE - 1)
        left = min(last_x, max(F(0), u - half_width - F(0.5)))
        top = min(last_y, max(F(0), v - half_height - F(0.5)))
        right = min(last_x, u + half_width - F(0.5))
        bottom = min(last_y, v + half_height - F(0.5))
        # rounded by casts: math.ceil and math.floor are calls
        x0, y0 = int(left), int(top)
        x0 += F(x0) < left
        y0 += F(y0) < top
        if right < F(x0) or bottom < F(y0):
            screen[i, 6] = F(-1)
            continue
        from_x, to_x = x0 // TILE, int(right) // TILE + 1
        from_y, to_y = y0 // TILE, int(bottom) // TILE + 1
        bounds[i, 0] = from_x
        bounds[i, 1] = to_x
        bounds[i, 2] = from_y
        bounds[i, 3] = to_y
        if to_x - from_x == 1 or to_y - from_y == 1:
            count[i] = (to_x - from_x) * (to_y - from_y)
            continue
        a, b, c = screen[i, 2], screen[i, 3], screen[i, 4]
        reach = F(2) * math.log(screen[i, 5] / alpha_cut)
        touched = 0
        for ty in range(from_y, to_y):
            dy = F(ty * TILE) + F(0.5) - v
            for tx in range(from_x, to_x):
                dx = F(tx * TILE) + F(0.5) - u
                if _touches(dx, dx + F(TILE - 1), dy, dy + F(TILE - 1), a, b, c, reach):
                    touched += 1
        count[i] = touched
        if touched == 0:
            screen[i, 6] = F(-1)


@kernel(parallel=True)
def count_tiles(  # type: ignore[no-untyped-def]
    screen: Floats, tiles_x: int, tiles_y: int, alpha_cut: np.float32, bounds: Ints, count: Ints
):
    """Bounds [N, 4] (x from, x to, y from, y to; in tiles) and number of tiles touched [N].

    A Gaussian that touches none is marked in `screen` as not visible.
    """
    number = screen.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _count_chunk(np.int64(chunk), screen, tiles_x, tiles_y, alpha_cut, bounds, count)


@kernel()
def order_by_depth(depth_bits, count):  # type: ignore[no-untyped-def]
    """Indices of the Gaussians that touch a tile, nearest first; equal depths keep their order.

    Args:
        depth_bits: [N] uint32, the bits of positive float32 depths, which sort like the depths.
        count: [N] int32.
    """
    visible = 0
    for i in range(count.shape[0]):
        if count[i] > 0:
            visible += 1
    order = np.empty(visible, np.int32)
    keys = np.empty(visible, np.uint32)
    k = 0
    for i in range(count.shape[0]):
        if count[i] > 0:
            order[k] = i
            keys[k] = depth_bits[i]
            k += 1
    other_order, other_keys = np.empty_like(order), np.empty_like(keys)
    digits = 1 << _DIGIT_BITS
    for sweep in range(3):
        shift = np.uint32(sweep * _DIGIT_BITS)
        start = np.zeros(digits + 1, np.int64)
        for k in range(visible):
            start[((keys[k] >> shift) & np.uint32(digits - 1)) + 1] += 1
        for digit in range(digits):
            start[digit + 1] += start[digit]
        for k in range(visible):
            digit = (keys[k] >> shift) & np.uint32(digits - 1)
            to = start[digit]
            start[digit] = to + 1
            other_keys[to] = keys[k]
            other_order[to] = order[k]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


@helper
def _list_chunk(chunk, screen, bounds, first_slot, tiles_x, alpha_cut, tile_of_slot):  # type: ignore[no-untyped-def]
    """One chunk of `list_tiles`."""
    number = bounds.shape[0]
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        slot, after = first_slot[i], first_slot[i + 1]
        if slot == after:
            continue
        whole = (bounds[i, 1] - bounds[i, 0]) * (bounds[i, 3] - bounds[i, 2]) == after - slot
        u, v, a, b, c = screen[i, 0], screen[i, 1], screen[i, 2], screen[i, 3], screen[i, 4]
        reach = F(2) * math.log(screen[i, 5] / alpha_cut) if not whole else F(0)
        for ty in range(bounds[i, 2], bounds[i, 3]):
            dy = F(ty * TILE) + F(0.5) - v
            for tx in range(bounds[i, 0], bounds[i, 1]):
                dx = F(tx * TILE) + F(0.5) - u
                if slot < after and (
                    whole or _touches(dx, dx + F(TILE - 1), dy, dy + F(TILE - 1), a, b, c, reach)
                ):
                    tile_of_slot[slot] = ty * tiles_x + tx
                    slot += 1


@kernel(parallel=True)
def list_tiles(  # type: ignore[no-untyped-def]
    screen: Floats, bounds: Ints, first_slot: Ints, tiles_x: int, alpha_cut: np.float32,
    tile_of_slot: Ints,
):  # fmt: skip
    """The tiles that each Gaussian touches, in raster order.

    Args:
        bounds, first_slot: from `count_tiles`, and the sums of its counts before each Gaussian.
        tile_of_slot: [M] output.
    """
    number = bounds.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _list_chunk(np.int64(chunk), screen, bounds, first_slot, tiles_x, alpha_cut, tile_of_slot)


@kernel()
def fill_tiles(order, first_slot, tile_of_slot, tiles):  # type: ignore[no-untyped-def]
    """List the Gaussians of every tile, nearest first.

    Args:
        order: from `order_by_depth`.
        first_slot, tile_of_slot: from `list_tiles`.
        tiles: number of tiles.

    Returns:
        offsets: [tiles + 1] int32, where each tile's part of `members` begins.
        members: [M] int32, Gaussians by tile.
        slots: [M] int32, for each of `members` its slot, which are those of a Gaussian one after
            another, its tiles in raster order.
    """
    offsets = np.zeros(tiles + 1, np.int32)
    for slot in range(tile_of_slot.shape[0]):
        offsets[tile_of_slot[slot] + 1] += 1
    for tile in range(tiles):
        offsets[tile + 1] += offsets[tile]
    position = offsets[:-1].copy()
    members = np.empty_like(tile_of_slot)
    slots = np.empty_like(tile_of_slot)
    for k in range(order.shape[0]):
        i = order[k]
        for slot in range(first_slot[i], first_slot[i + 1]):
            tile = tile_of_slot[slot]
            at = position[tile]
            members[at] = i
            slots[at] = slot
            position[tile] = at + 1
    return offsets, members, slots
