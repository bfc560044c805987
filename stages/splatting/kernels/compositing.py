"""Alpha compositing of projected Gaussians and its gradient, as numba kernels.

A tile is 32x32 pixels, in 64 blocks of 4x4: a block is one vector of 16 lanes (see `lanes`), and
what a Gaussian touches of a tile is one number of 64 bits. The first three features of a Gaussian
are its colour; any further ones (depth, flow, ...) run in a loop of their own over the same
weights, so that one compiled kernel serves every number of channels. No atomics on results: each
pair (tile, Gaussian) has its own slot of sums, and `gathering.gather` adds the slots of a Gaussian
in a fixed order. Threads take the next tile as they are free: which does one changes nothing.

With t = dx + (b / a) dy the ellipse a dx^2 + 2 b dx dy + c dy^2 is a t^2 + e dy^2, where 1 / e is
the variance along y: no mixed term, and no cancellation between large terms far from the centre of
a long thin Gaussian.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.lanes.blocks import (
    BLOCK,
    BLOCK_X,
    BLOCK_Y,
    BLOCKS,
    LANES,
    SIDE,
    TILE,
    exp2,
    exp2_constants,
    lowest_bit,
    pixels,
    read_tile,
    take_number,
    touched_blocks,
    workspace,
    write_tile,
)
from stages.splatting.lanes.vectors import (
    absolute,
    any_of,
    at_most,
    constant,
    item,
    largest,
    load,
    prefetch,
    spread,
    store,
    sums,
    where,
)

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
Bits = npt.NDArray[np.int64]
F = np.float32
I = np.int32

#: largest alpha of one Gaussian (as gsplat; 3DGS has .99), and transmittance below which a pixel is
#: finished
ALPHA_MAX = F(0.999)
TRANSMITTANCE_MIN = F(1e-4)
NEVER = I(2147483647)
HALF_LOG2E = F(0.5 * 1.4426950408889634)
#: a slot holds 11 sums and this many further features; what is more takes 16 each time
FIRST_EXTRAS = 5
#: pairs ahead whose Gaussian is brought into the cache
AHEAD = 6
SCREEN_COLUMNS = 16


@helper
def _forward_tile(  # type: ignore[no-untyped-def]
    tile, tiles_x, offsets, members, screen, features, alpha_cut, mask, image, transmittance, stop,
    blocks, state, final, until,
):  # fmt: skip
    """One tile of `composite_forward`.

    `state` holds transmittance, colour and extras, `final` the transmittance of the pixels that are
    finished (0 in `state`), `until` the pair that finished them.
    """
    height, width = transmittance.shape[1], transmittance.shape[2]
    extras = image.shape[0] - 3
    masked = mask.shape[0] > 0
    x0 = (tile % tiles_x) * TILE
    y0 = (tile // tiles_x) * TILE
    for row in range((4 + extras) * BLOCKS):
        store(state, row, spread(F(0)))
    unfinished = 0  # a bit for each block
    for block in range(BLOCKS):
        some = False
        for lane in range(LANES):
            x, y = (
                x0 + block % SIDE * BLOCK + lane % BLOCK,
                y0 + block // SIDE * BLOCK + lane // BLOCK,
            )
            inside = x < width and y < height
            shown = inside and (not masked or mask[y, x])
            until[block, lane] = NEVER if shown else I(-1)
            state[block, lane] = F(1) if shown else F(0)
            final[block, lane] = F(1)
            some |= shown
        unfinished |= int(some) << block
    column, row = pixels()
    lowest, p0, p1, p2, p3, p4 = exp2_constants()
    alpha_max, left_min, cut = (
        constant(ALPHA_MAX), constant(TRANSMITTANCE_MIN), constant(alpha_cut)
    )  # fmt: skip
    last = offsets[tile + 1]
    k = offsets[tile]
    while k < last and unfinished != 0:
        if k + AHEAD < last:
            ahead = item(members, k + AHEAD)
            prefetch(screen, ahead * SCREEN_COLUMNS)
            prefetch(features, ahead * features.shape[1])
        i = members[k]
        mx = screen[i, 0] - F(x0) - F(0.5)
        my = screen[i, 1] - F(y0) - F(0.5)
        a, e, slope = screen[i, 2], screen[i, 9], screen[i, 11]
        todo = unfinished & touched_blocks(
            mx, my, e, slope, screen[i, 6], screen[i, 7], screen[i, 12], screen[i, 13]
        )
        blocks[k] = todo
        peak = screen[i, 10]
        a2, e2 = a * HALF_LOG2E, e * HALF_LOG2E
        c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
        here = I(k)
        from_x, from_y = column - mx, row - my
        while todo != 0:
            block = lowest_bit(todo)
            todo &= todo - 1
            dy = from_y + item(BLOCK_Y, block)
            t = (from_x + item(BLOCK_X, block)) + slope * dy
            power = (peak - e2 * dy * dy) - a2 * t * t
            alpha = at_most(exp2(power, lowest, p0, p1, p2, p3, p4), alpha_max)
            alpha = where(alpha >= cut, alpha, F(0))
            before = load(state, block)
            w = alpha * before
            left = before - w
            finished = (left < left_min) & (before > F(0))
            # seldom: what is stored here under a mask would be slow to read again
            if any_of(finished):
                store(until, block, where(finished, here, load(until, block)))
                store(final, block, where(finished, before, load(final, block)))
                w = where(finished, F(0), w)
                left = where(finished, F(0), left)
                if largest(load(until, block)) != NEVER:
                    unfinished &= ~(1 << block)
            store(state, block, left)
            store(state, BLOCKS + block, load(state, BLOCKS + block) + w * c0)
            store(state, 2 * BLOCKS + block, load(state, 2 * BLOCKS + block) + w * c1)
            store(state, 3 * BLOCKS + block, load(state, 3 * BLOCKS + block) + w * c2)
            for j in range(extras):
                vector = (4 + j) * BLOCKS + block
                store(state, vector, load(state, vector) + w * features[i, 3 + j])
        k += 1
    for rest in range(k, last):
        blocks[rest] = 0
    for block in range(BLOCKS):
        never = load(until, block) >= NEVER
        store(state, block, where(never, load(state, block), load(final, block)))
    write_tile(state, 0, x0, y0, transmittance, 0)
    write_tile(until, 0, x0, y0, stop, 0)
    for j in range(3 + extras):
        write_tile(state, (1 + j) * BLOCKS, x0, y0, image, j)


@kernel(parallel=True)
def composite_forward(  # type: ignore[no-untyped-def]
    workers: int, tiles_x: int, offsets: Ints, members: Ints, screen: Floats, features: Floats,
    alpha_cut: np.float32, mask: npt.NDArray[np.bool_], image: Floats, transmittance: Floats,
    stop: Ints, blocks: Bits,
):  # fmt: skip
    """Composite front to back.

    Args:
        workers: number of threads.
        tiles_x: width of the image in tiles.
        offsets, members: from `fill_tiles`.
        screen: [N, 16] projected Gaussians.
        features: [N, 3 + E].
        alpha_cut: alpha below which a contribution is left out.
        mask: [H, W] pixels to render, or [0, 0] for all.
        image: [3 + E, H, W] output, without background.
        transmittance: [1, H, W] output, what is left of the light behind.
        stop: [1, H, W] output, index into `members` of the first Gaussian that a pixel leaves out.
        blocks: [M] output, the blocks that each pair was composited in, a bit each.
    """
    tiles = offsets.shape[0] - 1
    vectors = (1 + image.shape[0]) * BLOCKS
    taken = np.zeros(1, np.int64)
    for _ in prange(workers):
        state, final = workspace(vectors), workspace(BLOCKS)
        until = workspace(BLOCKS).view(np.int32)
        tile = take_number(taken)
        while tile < tiles:
            _forward_tile(
                tile, tiles_x, offsets, members, screen, features, alpha_cut, mask, image,
                transmittance, stop, blocks, state, final, until,
            )  # fmt: skip
            tile = take_number(taken)


@helper
def _backward_tile(  # type: ignore[no-untyped-def]
    tile, tiles_x, offsets, members, slots, screen, features, alpha_cut, transmittance, stop,
    blocks, d_image, d_transmittance, slot_sums, state, until, extra_sums,
):  # fmt: skip
    """One tile of `composite_backward`.

    `state` holds transmittance, light from behind, gradients of the colour and of the extras.
    """
    extras = d_image.shape[0] - 3
    room = slot_sums.shape[1] // LANES
    x0 = (tile % tiles_x) * TILE
    y0 = (tile // tiles_x) * TILE
    read_tile(stop, 0, x0, y0, until, 0)
    read_tile(transmittance, 0, x0, y0, state, 0)
    read_tile(d_transmittance, 0, x0, y0, state, BLOCKS)
    for block in range(BLOCKS):
        store(state, BLOCKS + block, load(state, BLOCKS + block) * load(state, block))
    for j in range(3 + extras):
        read_tile(d_image, j, x0, y0, state, (2 + j) * BLOCKS)
    column, row = pixels()
    lowest, p0, p1, p2, p3, p4 = exp2_constants()
    alpha_max, one, cut = constant(ALPHA_MAX), constant(F(1)), constant(alpha_cut)
    for k in range(offsets[tile + 1] - 1, offsets[tile] - 1, -1):
        todo = blocks[k]
        slot = item(slots, k) * room
        if todo == 0:
            for j in range(room):
                store(slot_sums, slot + j, spread(F(0)))
            continue
        if k - AHEAD >= offsets[tile]:
            ahead = item(members, k - AHEAD)
            prefetch(screen, ahead * SCREEN_COLUMNS)
            prefetch(features, ahead * features.shape[1])
        i = members[k]
        mx = screen[i, 0] - F(x0) - F(0.5)
        my = screen[i, 1] - F(y0) - F(0.5)
        b, e, slope = screen[i, 3], screen[i, 9], screen[i, 11]
        a2, e2 = screen[i, 2] * HALF_LOG2E, e * HALF_LOG2E
        peak = screen[i, 10]
        red, green, blue = features[i, 0], features[i, 1], features[i, 2]
        here = I(k)
        from_x, from_y = column - mx, row - my
        s = sx = sy = sxx = sxy = syy = abs_x = abs_y = s_red = s_green = s_blue = spread(F(0))
        for j in range(extras):
            store(extra_sums, j, spread(F(0)))
        while todo != 0:
            block = lowest_bit(todo)
            todo &= todo - 1
            dx = from_x + item(BLOCK_X, block)
            dy = from_y + item(BLOCK_Y, block)
            t = dx + slope * dy
            power = (peak - e2 * dy * dy) - a2 * t * t
            raw = exp2(power, lowest, p0, p1, p2, p3, p4)
            taken = (raw >= cut) & (load(until, block) > here)
            alpha = where(taken, at_most(raw, alpha_max), F(0))
            inverse = one / (one - alpha)
            before = load(state, block) * inverse
            d_red, d_green = load(state, 2 * BLOCKS + block), load(state, 3 * BLOCKS + block)
            d_blue = load(state, 4 * BLOCKS + block)
            along = d_red * red + d_green * green + d_blue * blue
            w = alpha * before
            for j in range(extras):
                d_extra = load(state, (5 + j) * BLOCKS + block)
                along += d_extra * features[i, 3 + j]
                store(extra_sums, j, load(extra_sums, j) + w * d_extra)
            rest = load(state, BLOCKS + block)
            ds = alpha * (rest * inverse - before * along)
            ds = where(raw <= alpha_max, ds, F(0))
            store(state, BLOCKS + block, rest + w * along)
            store(state, block, before)
            s += ds
            by_x, by_y = ds * dx, ds * dy
            sx += by_x
            sy += by_y
            sxx += by_x * dx
            sxy += by_x * dy
            syy += by_y * dy
            abs_x += absolute(ds * t)
            abs_y += absolute(ds * (t * b + e * dy))
            s_red += w * d_red
            s_green += w * d_green
            s_blue += w * d_blue
        if extras == 0:
            # the usual case; sums of nothing cost nothing
            zero = spread(F(0))
            store(slot_sums, slot, sums((
                s, sy, syy, sx, sxy, sxx, abs_x, abs_y, s_red, s_green, s_blue,
                zero, zero, zero, zero, zero,
            )))  # fmt: skip
            continue
        store(slot_sums, slot, sums((
            s, sy, syy, sx, sxy, sxx, abs_x, abs_y, s_red, s_green, s_blue,
            load(extra_sums, 0), load(extra_sums, 1), load(extra_sums, 2), load(extra_sums, 3),
            load(extra_sums, 4),
        )))  # fmt: skip
        for j in range(1, room):
            m = FIRST_EXTRAS + LANES * (j - 1)
            store(slot_sums, slot + j, sums((
                load(extra_sums, m), load(extra_sums, m + 1), load(extra_sums, m + 2),
                load(extra_sums, m + 3), load(extra_sums, m + 4), load(extra_sums, m + 5),
                load(extra_sums, m + 6), load(extra_sums, m + 7), load(extra_sums, m + 8),
                load(extra_sums, m + 9), load(extra_sums, m + 10), load(extra_sums, m + 11),
                load(extra_sums, m + 12), load(extra_sums, m + 13), load(extra_sums, m + 14),
                load(extra_sums, m + 15),
            )))  # fmt: skip


@kernel(parallel=True)
def composite_backward(  # type: ignore[no-untyped-def]
    workers: int, tiles_x: int, offsets: Ints, members: Ints, slots: Ints, screen: Floats,
    features: Floats, alpha_cut: np.float32, transmittance: Floats, stop: Ints, blocks: Bits,
    d_image: Floats, d_transmittance: Floats, slot_sums: Floats,
):  # fmt: skip
    """Gradient of `composite_forward`, back to front.

    Transmittance is rebuilt from its final value, from the last Gaussian that each pixel took.
    With exp(-s) the Gaussian and ds the gradient of s, a slot holds the sums over its pixels of
    ds (1, dy, dy^2, dx, dx dy, dx^2), |ds t|, |ds ds/dy|, the blending weight times the gradient of
    each of the features; `gather` makes gradients of them.

    Args:
        slots: from `fill_tiles`, the row of `slot_sums` of each pair.
        d_image: [3 + E, H, W], d_transmittance: [1, H, W]: gradients of the outputs.
        slot_sums: [M, 16 n] output.
    """
    tiles = offsets.shape[0] - 1
    room = slot_sums.shape[1] // LANES
    vectors = (2 + d_image.shape[0]) * BLOCKS
    taken = np.zeros(1, np.int64)
    for _ in prange(workers):
        state, until = workspace(vectors), workspace(BLOCKS).view(np.int32)
        extra_sums = workspace(FIRST_EXTRAS + LANES * (room - 1))
        tile = take_number(taken)
        while tile < tiles:
            _backward_tile(
                tile, tiles_x, offsets, members, slots, screen, features, alpha_cut, transmittance,
                stop, blocks, d_image, d_transmittance, slot_sums, state, until, extra_sums,
            )  # fmt: skip
            tile = take_number(taken)


def slot_columns(features: int) -> int:
    """Columns of a slot for 3 + E features."""
    more = max(0, features - 3 - FIRST_EXTRAS)
    return LANES * (1 + -(-more // LANES))


def aligned_empty(rows: int, columns: int) -> Floats:
    """[rows, columns] float32 that begins at a cache line (see `workspace`)."""
    raw = np.empty(rows * columns + LANES, np.float32)
    start = (-(raw.ctypes.data // raw.itemsize)) % LANES
    return raw[start : start + rows * columns].reshape(rows, columns)
