"""Alpha compositing of projected Gaussians in 16x16 tiles and its gradient, as numba kernels.

A row of a tile is one vector of 16 lanes (see `lanes`). The first three features of a Gaussian are
its colour; any further ones (depth, flow, ...) run in a loop of their own over the same weights, so
that one compiled kernel serves every number of channels. No atomics: each pair (tile, Gaussian)
has its own slot of sums, and `gather.gather` adds the slots of a Gaussian in a fixed order.

With t = dx + (b / a) dy the ellipse a dx^2 + 2 b dx dy + c dy^2 is a t^2 + e dy^2, where 1 / e is
the variance along y: one shift per row instead of a mixed term, and no cancellation between large
terms far from the centre of a long thin Gaussian.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from stages.splatting.lanes import (
    absolute,
    any_of,
    at_least,
    at_most,
    constant,
    count_up,
    item,
    largest,
    load,
    prefetch,
    scale_by_power,
    spread,
    store,
    sums,
    to_float,
    truncate,
    where,
)

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32
I = np.int32

TILE = 16
GOLDEN = 0.6180339887
#: largest alpha of one Gaussian, and transmittance below which a pixel is finished (as 3DGS)
ALPHA_MAX = F(0.99)
TRANSMITTANCE_MIN = F(1e-4)
NEVER = I(2147483647)
HALF_LOG2E = F(0.5 * 1.4426950408889634)
#: a slot holds 11 sums and this many further features; what is more takes 16 each time
FIRST_EXTRAS = 5
#: pairs between two looks at which rows of a tile are finished
PATIENCE = 16
#: pairs ahead whose Gaussian is brought into the cache
AHEAD = 4
SCREEN_COLUMNS = 12
#: px that the rows of an ellipse are widened by, against rounding
SAFETY = F(0.01)


@njit(inline="always", error_model="numpy")
def _exp2(x, lowest, p0, p1, p2, p3, p4):  # type: ignore[no-untyped-def]
    """2^x for x <= 0, relative error 3e-6: minimax polynomial on (-1, 0] times a power of two.

    `lowest` and the coefficients as `_exp2_constants` gives them.
    """
    x = at_least(x, lowest)
    whole = truncate(x)
    part = x - to_float(whole)
    return scale_by_power(p0 + part * (p1 + part * (p2 + part * (p3 + part * p4))), whole)


@njit(inline="always", error_model="numpy")
def _exp2_constants():  # type: ignore[no-untyped-def]
    return (
        constant(F(-126.0)), constant(F(0.99999741)), constant(F(0.69303020)),
        constant(F(0.23934107)), constant(F(0.053074066)), constant(F(0.0067670840)),
    )  # fmt: skip


@njit(inline="always", error_model="numpy")
def _rows(mx, my, a, b, c, e, slope, reach, columns, rows):  # type: ignore[no-untyped-def]
    """First row of a tile that an ellipse touches, and the one after the last.

    Args:
        mx, my: its centre, relative to the first pixel of the tile.
        a, b, c, e, slope: its inverse covariance, 1 / variance along y, and b / a.
        reach: its half height.
        columns, rows: size of the tile.
    """
    # where the ellipse is highest and lowest; outside the tile the nearer edge counts. No branch:
    # which way it goes can't be foreseen
    shift = slope * reach
    left, right = -mx, F(columns - 1) - mx
    at_top, at_bottom = min(max(-shift, left), right), min(max(shift, left), right)
    level, curve, inverse = c * e * reach * reach, a * e, F(1) / c
    # not a number if the ellipse does not reach that edge: then all rows
    top = my + (math.sqrt(level - curve * at_top * at_top) - b * at_top) * inverse + SAFETY
    bottom = my - (math.sqrt(level - curve * at_bottom * at_bottom) + b * at_bottom) * inverse
    bottom -= SAFETY
    # math.floor and math.ceil would be calls, around which all vectors are saved
    bottom = bottom if bottom > F(0) else F(0)
    bottom = bottom if bottom < F(rows) else F(rows)
    top = top if top < F(rows - 1) else F(rows - 1)
    first = I(bottom)
    first += I(F(first) < bottom)
    after = I(top) + I(1) if top >= F(0) else I(0)
    return first, max(first, after)


@njit(error_model="numpy")
def _workspace(vectors):  # type: ignore[no-untyped-def]
    """Zeros [vectors, 16] that begin at a cache line: a vector across two lines costs double."""
    raw = np.zeros((vectors + 1) * TILE, np.float32)
    start = (-(raw.ctypes.data // 4)) % TILE
    return raw[start : start + vectors * TILE].reshape(vectors, TILE)


@njit(parallel=True, cache=True, error_model="numpy")
def composite_forward(  # type: ignore[no-untyped-def]
    tiles_x: int, tiles_y: int, stride: int, offsets: Ints, members: Ints, screen: Floats,
    features: Floats, alpha_cut: np.float32, mask: npt.NDArray[np.bool_], image: Floats,
    transmittance: Floats, stop: Ints, end: Ints, spans: Ints,
):  # fmt: skip
    """Composite front to back.

    Args:
        tiles_x, tiles_y: size of the image in tiles.
        stride: odd step through the tiles, coprime to their number: spreads the full tiles in the
            middle of an image over the threads.
        offsets, members: from `fill_tiles`.
        screen: [N, 12] projected Gaussians.
        features: [N, 3 + E].
        alpha_cut: alpha below which a contribution is left out.
        mask: [H, W] pixels to render, or [0, 0] for all.
        image: [3 + E, H, W] output, without background.
        transmittance: [H, W] output, what is left of the light behind.
        stop: [H, W] output, index into `members` of the first Gaussian that a pixel leaves out.
        end: [tiles] output, where each tile stopped.
        spans: [M] output, first row and the one after the last, times 256, of each pair.
    """
    height, width = transmittance.shape
    extras = image.shape[0] - 3
    tiles = tiles_x * tiles_y
    masked = mask.shape[0] > 0
    for job in prange(tiles):
        tile = (job * stride) % tiles
        x0 = (tile % tiles_x) * TILE
        y0 = (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        state = _workspace((4 + extras) * TILE)  # transmittance, colour, extras
        final = _workspace(TILE)  # transmittance of the pixels that are finished, 0 in state
        until = np.full((TILE, TILE), I(-1), np.int32)
        for r in range(rows):
            for x in range(columns):
                if not masked or mask[y0 + r, x0 + x]:
                    until[r, x] = NEVER
                    state[r, x] = F(1)
                else:
                    final[r, x] = F(1)
        open_rows = 0  # a bit each
        lane = count_up()
        lowest, p0, p1, p2, p3, p4 = _exp2_constants()
        alpha_max, left_min, cut = (
            constant(ALPHA_MAX), constant(TRANSMITTANCE_MIN), constant(alpha_cut)
        )  # fmt: skip
        k = offsets[tile]
        last = offsets[tile + 1]
        look = k
        while k < last:
            if k == look:
                look += PATIENCE
                open_rows = 0
                for r in range(TILE):
                    open_rows |= int(largest(load(until, r)) == NEVER) << r
                if open_rows == 0:
                    break
            if k + AHEAD < last:
                prefetch(screen, item(members, k + AHEAD) * SCREEN_COLUMNS)
            i = members[k]
            mx = screen[i, 0] - F(x0) - F(0.5)
            my = screen[i, 1] - F(y0) - F(0.5)
            a, b, c, e = screen[i, 2], screen[i, 3], screen[i, 4], screen[i, 9]
            slope = screen[i, 11]
            first, after = _rows(mx, my, a, b, c, e, slope, screen[i, 7], columns, rows)
            spans[k] = first + I(256) * after
            peak = screen[i, 10]
            a2, e2 = a * HALF_LOG2E, e * HALF_LOG2E
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            here = I(k)
            for r in range(first, after):
                if (open_rows >> r) & 1 == 0:
                    continue
                dy = F(r) - my
                t = lane - (mx - slope * dy)
                power = (peak - e2 * dy * dy) - a2 * t * t
                alpha = at_most(_exp2(power, lowest, p0, p1, p2, p3, p4), alpha_max)
                alpha = where(alpha >= cut, alpha, F(0))
                before = load(state, r)
                w = alpha * before
                left = before - w
                finished = (left < left_min) & (before > F(0))
                # seldom: what is stored here under a mask would be slow to read again
                if any_of(finished):
                    store(until, r, where(finished, here, load(until, r)))
                    store(final, r, where(finished, before, load(final, r)))
                    w = where(finished, F(0), w)
                    left = where(finished, F(0), left)
                store(state, r, left)
                store(state, TILE + r, load(state, TILE + r) + w * c0)
                store(state, 2 * TILE + r, load(state, 2 * TILE + r) + w * c1)
                store(state, 3 * TILE + r, load(state, 3 * TILE + r) + w * c2)
                for j in range(extras):
                    row = (4 + j) * TILE + r
                    store(state, row, load(state, row) + w * features[i, 3 + j])
            k += 1
        end[tile] = k
        for r in range(rows):
            for x in range(columns):
                stop[y0 + r, x0 + x] = until[r, x]
                transmittance[y0 + r, x0 + x] = state[r, x] if until[r, x] == NEVER else final[r, x]
            for j in range(3 + extras):
                for x in range(columns):
                    image[j, y0 + r, x0 + x] = state[(1 + j) * TILE + r, x]


@njit(parallel=True, cache=True, error_model="numpy")
def composite_backward(  # type: ignore[no-untyped-def]
    tiles_x: int, tiles_y: int, stride: int, offsets: Ints, members: Ints, screen: Floats,
    features: Floats, alpha_cut: np.float32, transmittance: Floats, stop: Ints, end: Ints,
    spans: Ints, d_image: Floats, d_transmittance: Floats, slot_sums: Floats,
):  # fmt: skip
    """Gradient of `composite_forward`, back to front.

    Transmittance is rebuilt from its final value, from the last Gaussian that each pixel took.
    With exp(-s) the Gaussian and ds the gradient of s, a slot holds the sums over its pixels of
    ds (1, dy, dy^2, dx, dx dy, dx^2), |ds t|, |ds ds/dy|, the blending weight times the gradient of
    each of the features; `gather` makes gradients of them.

    Args:
        d_image: [3 + E, H, W], d_transmittance: [H, W]: gradients of the outputs.
        slot_sums: [M, 16 n] output.
    """
    height, width = transmittance.shape
    extras = d_image.shape[0] - 3
    room = slot_sums.shape[1] // TILE
    tiles = tiles_x * tiles_y
    for job in prange(tiles):
        tile = (job * stride) % tiles
        x0 = (tile % tiles_x) * TILE
        y0 = (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        # transmittance, light from behind, gradients of the colour and of the other features
        state = _workspace((5 + extras) * TILE)
        until = np.full((TILE, TILE), I(-1), np.int32)
        extra_sums = _workspace(FIRST_EXTRAS + TILE * (room - 1))
        for r in range(rows):
            for x in range(columns):
                until[r, x] = stop[y0 + r, x0 + x]
                left = transmittance[y0 + r, x0 + x]
                state[r, x] = left
                state[TILE + r, x] = left * d_transmittance[y0 + r, x0 + x]
            for j in range(3 + extras):
                for x in range(columns):
                    state[(2 + j) * TILE + r, x] = d_image[j, y0 + r, x0 + x]
        row_until = np.empty(TILE, np.int32)
        for r in range(TILE):
            row_until[r] = largest(load(until, r))
        lane = count_up()
        lowest, p0, p1, p2, p3, p4 = _exp2_constants()
        alpha_max, one, cut = constant(ALPHA_MAX), constant(F(1)), constant(alpha_cut)
        for k in range(end[tile] - 1, offsets[tile] - 1, -1):
            i = members[k]
            mx = screen[i, 0] - F(x0) - F(0.5)
            my = screen[i, 1] - F(y0) - F(0.5)
            b, e = screen[i, 3], screen[i, 9]
            slope = screen[i, 11]
            a2, e2 = screen[i, 2] * HALF_LOG2E, e * HALF_LOG2E
            peak = screen[i, 10]
            red, green, blue = features[i, 0], features[i, 1], features[i, 2]
            here = I(k)
            if k - AHEAD >= offsets[tile]:
                prefetch(screen, item(members, k - AHEAD) * SCREEN_COLUMNS)
            s = sy = syy = abs_x = abs_y = s_red = s_green = s_blue = spread(F(0))
            for j in range(extras):
                store(extra_sums, j, spread(F(0)))
            for r in range(spans[k] % 256, spans[k] // 256):
                if item(row_until, r) <= here:
                    continue
                dy = F(r) - my
                t = lane - (mx - slope * dy)
                power = (peak - e2 * dy * dy) - a2 * t * t
                raw = _exp2(power, lowest, p0, p1, p2, p3, p4)
                taken = (raw >= cut) & (load(until, r) > here)
                alpha = where(taken, at_most(raw, alpha_max), F(0))
                inverse = one / (one - alpha)
                before = load(state, r) * inverse
                d_red, d_green = load(state, 2 * TILE + r), load(state, 3 * TILE + r)
                d_blue = load(state, 4 * TILE + r)
                along = d_red * red + d_green * green + d_blue * blue
                w = alpha * before
                for j in range(extras):
                    d_extra = load(state, (5 + j) * TILE + r)
                    along += d_extra * features[i, 3 + j]
                    store(extra_sums, j, load(extra_sums, j) + w * d_extra)
                rest = load(state, TILE + r)
                ds = alpha * (rest * inverse - before * along)
                ds = where(raw <= alpha_max, ds, F(0))
                store(state, TILE + r, rest + w * along)
                store(state, r, before)
                s += ds
                d = ds * dy
                sy += d
                syy += d * dy
                abs_x += absolute(ds * t)
                abs_y += absolute(ds * (t * b + e * dy))
                s_red += w * d_red
                s_green += w * d_green
                s_blue += w * d_blue
            dx = lane - mx
            sx, sxy = s * dx, sy * dx
            if extras == 0:
                # the usual case; sums of nothing cost nothing
                zero = spread(F(0))
                store(slot_sums, k * room, sums((
                    s, sy, syy, sx, sxy, sx * dx, abs_x, abs_y, s_red, s_green, s_blue,
                    zero, zero, zero, zero, zero,
                )))  # fmt: skip
                continue
            store(slot_sums, k * room, sums((
                s, sy, syy, sx, sxy, sx * dx, abs_x, abs_y, s_red, s_green, s_blue,
                load(extra_sums, 0), load(extra_sums, 1), load(extra_sums, 2), load(extra_sums, 3),
                load(extra_sums, 4),
            )))  # fmt: skip
            for j in range(1, room):
                m = FIRST_EXTRAS + TILE * (j - 1)
                store(slot_sums, k * room + j, sums((
                    load(extra_sums, m), load(extra_sums, m + 1), load(extra_sums, m + 2),
                    load(extra_sums, m + 3), load(extra_sums, m + 4), load(extra_sums, m + 5),
                    load(extra_sums, m + 6), load(extra_sums, m + 7), load(extra_sums, m + 8),
                    load(extra_sums, m + 9), load(extra_sums, m + 10), load(extra_sums, m + 11),
                    load(extra_sums, m + 12), load(extra_sums, m + 13), load(extra_sums, m + 14),
                    load(extra_sums, m + 15),
                )))  # fmt: skip
        for k in range(end[tile], offsets[tile + 1]):
            for j in range(room):
                store(slot_sums, k * room + j, spread(F(0)))


def slot_columns(features: int) -> int:
    """Columns of a slot for 3 + E features."""
    more = max(0, features - 3 - FIRST_EXTRAS)
    return TILE * (1 + -(-more // TILE))


def aligned_empty(rows: int, columns: int) -> Floats:
    """[rows, columns] float32 that begins at a cache line (see `_workspace`)."""
    raw = np.empty(rows * columns + TILE, np.float32)
    start = (-(raw.ctypes.data // raw.itemsize)) % TILE
    return raw[start : start + rows * columns].reshape(rows, columns)


def tile_stride(tiles: int) -> int:
    """A step near the golden ratio of `tiles` and coprime to it."""
    step = max(1, round(tiles * GOLDEN))
    while math.gcd(step, tiles) != 1:
        step += 1
    return step
