"""Alpha compositing of projected Gaussians in 16x16 tiles and its gradient, as numba kernels.

A row of a tile is the vectorised loop (16 lanes). The first three features of a Gaussian are its
colour; any further ones (depth, flow, ...) run in a loop of their own over the same weights, so
that one compiled kernel serves every number of channels. No atomics: each pair (tile, Gaussian)
has its own slot of gradients, and `gather` sums the slots of a Gaussian in a fixed order.

Look at the assembly when changing these loops (`benchmarks/rasterizer.py --assembly`): a small
change can stop LLVM from vectorising them, at five times the cost.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]
F = np.float32
I = np.int32

TILE = 16
CHUNK = 256
GOLDEN = 0.6180339887
#: largest alpha of one Gaussian, and transmittance below which a pixel is finished (as 3DGS)
ALPHA_MAX = F(0.99)
TRANSMITTANCE_MIN = F(1e-4)
NEVER = I(2147483647)
HALF_LOG2E = F(0.5 * 1.4426950408889634)
SLOT_COLUMNS = 8


@intrinsic
def _float_from_bits(typing_context, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@njit(inline="always", fastmath=True, error_model="numpy")
def _exp2(x):  # type: ignore[no-untyped-def]
    """2^x for x <= 0, relative error 3e-6: minimax polynomial on (-1, 0] times a power of two."""
    x = max(x, F(-126.0))
    whole = I(x)
    part = x - F(whole)
    power = F(0.99999741) + part * (
        F(0.69303020) + part * (F(0.23934107) + part * (F(0.053074066) + part * F(0.0067670840)))
    )
    bits = I((whole + I(127)) << I(23))
    return power * _float_from_bits(bits)  # type: ignore[call-arg]  # numba passes the context


@njit(parallel=True, cache=True, fastmath=True, error_model="numpy")
def composite_forward(  # type: ignore[no-untyped-def]
    tiles_x: int, tiles_y: int, stride: int, offsets: Ints, members: Ints, screen: Floats,
    features: Floats, alpha_cut: np.float32, image: Floats, transmittance: Floats, stop: Ints,
    end: Ints,
):  # fmt: skip
    """Composite front to back.

    Args:
        tiles_x, tiles_y: size of the image in tiles.
        stride: odd step through the tiles, coprime to their number: spreads the full tiles in the
            middle of an image over the threads.
        offsets, members: from `fill_tiles`.
        screen: [N, 9] projected Gaussians.
        features: [N, 3 + E].
        alpha_cut: alpha below which a contribution is left out.
        image: [3 + E, H, W] output, without background.
        transmittance: [H, W] output, what is left of the light behind.
        stop: [H, W] output, index into `members` of the first Gaussian that a pixel leaves out.
        end: [tiles] output, where each tile stopped.
    """
    height, width = transmittance.shape
    extras = image.shape[0] - 3
    tiles = tiles_x * tiles_y
    for job in prange(tiles):
        tile = (job * stride) % tiles
        x0 = (tile % tiles_x) * TILE
        y0 = (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        # one array: each further one costs the vectorised loop checks that they don't overlap
        state = np.zeros((4, TILE, TILE), np.float32)  # colour, transmittance
        state[3] = F(1)
        until = np.full((TILE, TILE), NEVER, np.int32)
        extra = np.zeros((extras, TILE, TILE), np.float32)
        weights = np.zeros(TILE, np.float32)
        for r in range(TILE):
            for x in range(TILE):
                if r >= rows or x >= columns:
                    until[r, x] = I(-1)
        k = offsets[tile]
        last = offsets[tile + 1]
        while k < last:
            i = members[k]
            mx = screen[i, 0] - F(x0) - F(0.5)
            my = screen[i, 1] - F(y0) - F(0.5)
            a = screen[i, 2] * HALF_LOG2E
            b = screen[i, 3] * (HALF_LOG2E * F(2))
            c = screen[i, 4] * HALF_LOG2E
            opacity = screen[i, 5]
            reach = screen[i, 7]
            c0, c1, c2 = features[i, 0], features[i, 1], features[i, 2]
            here = I(k)
            for r in range(
                max(0, math.ceil(my - reach)), min(rows - 1, math.floor(my + reach)) + 1
            ):
                dy = F(r) - my
                cyy = c * dy * dy
                by = b * dy
                for x in range(TILE):
                    dx = F(x) - mx
                    alpha = min(opacity * _exp2(-(cyy + dx * (by + a * dx))), ALPHA_MAX)
                    alpha = alpha if alpha >= alpha_cut else F(0)
                    before = state[3, r, x]
                    u = until[r, x]
                    u = u if before * (F(1) - alpha) >= TRANSMITTANCE_MIN else min(u, here)
                    until[r, x] = u
                    alpha = alpha if here < u else F(0)
                    w = alpha * before
                    state[3, r, x] = before - w
                    state[0, r, x] += w * c0
                    state[1, r, x] += w * c1
                    state[2, r, x] += w * c2
                    weights[x] = w
                for e in range(extras):
                    value = features[i, 3 + e]
                    for x in range(TILE):
                        extra[e, r, x] += weights[x] * value
            k += 1
            if (k & 15) == 0:
                latest = I(-1)
                for r in range(TILE):
                    for x in range(TILE):
                        latest = max(latest, until[r, x])
                if latest < NEVER:
                    break
        end[tile] = k
        for r in range(rows):
            for x in range(columns):
                image[0, y0 + r, x0 + x] = state[0, r, x]
                image[1, y0 + r, x0 + x] = state[1, r, x]
                image[2, y0 + r, x0 + x] = state[2, r, x]
                transmittance[y0 + r, x0 + x] = state[3, r, x]
                stop[y0 + r, x0 + x] = until[r, x]
            for e in range(extras):
                for x in range(columns):
                    image[3 + e, y0 + r, x0 + x] = extra[e, r, x]


@njit(parallel=True, cache=True, fastmath=True, error_model="numpy")
def composite_backward(  # type: ignore[no-untyped-def]
    tiles_x: int, tiles_y: int, stride: int, offsets: Ints, members: Ints, screen: Floats,
    features: Floats, alpha_cut: np.float32, transmittance: Floats, stop: Ints, end: Ints,
    d_image: Floats, d_transmittance: Floats, slot_gradient: Floats,
):  # fmt: skip
    """Gradient of `composite_forward`, back to front.

    Transmittance is rebuilt from its final value, from the last Gaussian that each pixel took.
    Per lane only sums of ds, ds dy, ds dy^2 are kept, where exp(-s) is the Gaussian: dx is the same
    for a lane, and dL/d(opacity) = -sum(ds) / opacity.

    Args:
        d_image: [3 + E, H, W], d_transmittance: [H, W]: gradients of the outputs.
        slot_gradient: [M, 8 + 3 + E] output: centre 2, conic a b c, opacity, sums of the absolute
            per-pixel gradients of the centre 2, features.
    """
    height, width = transmittance.shape
    extras = d_image.shape[0] - 3
    tiles = tiles_x * tiles_y
    for job in prange(tiles):
        tile = (job * stride) % tiles
        x0 = (tile % tiles_x) * TILE
        y0 = (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        # few arrays: each costs the vectorised loop checks that it overlaps no other
        state = np.zeros((2, TILE, TILE), np.float32)  # transmittance, light from behind
        until = np.full((TILE, TILE), I(-1), np.int32)
        d_colour = np.zeros((3, TILE, TILE), np.float32)
        d_extra = np.zeros((extras, TILE, TILE), np.float32)
        sums = np.zeros((10, TILE), np.float32)  # 8 sums; gradient through extras; weights
        extra_sums = np.zeros((extras, TILE), np.float32)
        for r in range(rows):
            for x in range(columns):
                state[0, r, x] = transmittance[y0 + r, x0 + x]
                until[r, x] = stop[y0 + r, x0 + x]
                state[1, r, x] = state[0, r, x] * d_transmittance[y0 + r, x0 + x]
                d_colour[0, r, x] = d_image[0, y0 + r, x0 + x]
                d_colour[1, r, x] = d_image[1, y0 + r, x0 + x]
                d_colour[2, r, x] = d_image[2, y0 + r, x0 + x]
            for e in range(extras):
                for x in range(columns):
                    d_extra[e, r, x] = d_image[3 + e, y0 + r, x0 + x]
        for k in range(end[tile] - 1, offsets[tile] - 1, -1):
            i = members[k]
            mx = screen[i, 0] - F(x0) - F(0.5)
            my = screen[i, 1] - F(y0) - F(0.5)
            a, b, c = screen[i, 2], screen[i, 3], screen[i, 4]
            a2, b2, c2 = a * HALF_LOG2E, b * (HALF_LOG2E * F(2)), c * HALF_LOG2E
            opacity = screen[i, 5]
            reach = screen[i, 7]
            red, green, blue = features[i, 0], features[i, 1], features[i, 2]
            here = I(k)
            for j in range(8):
                for x in range(TILE):
                    sums[j, x] = F(0)
            for e in range(extras):
                for x in range(TILE):
                    extra_sums[e, x] = F(0)
            for r in range(
                max(0, math.ceil(my - reach)), min(rows - 1, math.floor(my + reach)) + 1
            ):
                dy = F(r) - my
                cyy = c2 * dy * dy
                b2y = b2 * dy
                by = b * dy
                cy = c * dy
                if extras > 0:
                    for x in range(TILE):
                        sums[8, x] = F(0)
                for e in range(extras):
                    value = features[i, 3 + e]
                    for x in range(TILE):
                        sums[8, x] += value * d_extra[e, r, x]
                for x in range(TILE):
                    dx = F(x) - mx
                    raw = opacity * _exp2(-(cyy + dx * (b2y + a2 * dx)))
                    alpha = min(raw, ALPHA_MAX)
                    taken = (alpha >= alpha_cut) & (here < until[r, x])
                    alpha = alpha if taken else F(0)
                    inverse = F(1) / (F(1) - alpha)
                    before = state[0, r, x] * inverse
                    along = (
                        red * d_colour[0, r, x]
                        + green * d_colour[1, r, x]
                        + blue * d_colour[2, r, x]
                        + sums[8, x]
                    )
                    w = alpha * before
                    rest = state[1, r, x]
                    ds = alpha * (rest * inverse - before * along)
                    ds = ds if raw <= ALPHA_MAX else F(0)
                    state[1, r, x] = rest + w * along
                    state[0, r, x] = before
                    sums[0, x] += ds
                    sums[1, x] += ds * dy
                    sums[2, x] += ds * dy * dy
                    sums[3, x] += abs(ds * (a * dx + by))
                    sums[4, x] += abs(ds * (cy + b * dx))
                    sums[5, x] += w * d_colour[0, r, x]
                    sums[6, x] += w * d_colour[1, r, x]
                    sums[7, x] += w * d_colour[2, r, x]
                    sums[9, x] = w
                for e in range(extras):
                    for x in range(TILE):
                        extra_sums[e, x] += sums[9, x] * d_extra[e, r, x]
            s = sy = syy = sx = sxx = sxy = abs_x = abs_y = s_red = s_green = s_blue = F(0)
            for x in range(TILE):
                dx = F(x) - mx
                s += sums[0, x]
                sy += sums[1, x]
                syy += sums[2, x]
                sx += dx * sums[0, x]
                sxx += dx * dx * sums[0, x]
                sxy += dx * sums[1, x]
                abs_x += sums[3, x]
                abs_y += sums[4, x]
                s_red += sums[5, x]
                s_green += sums[6, x]
                s_blue += sums[7, x]
            slot_gradient[k, 0] = -(a * sx + b * sy)
            slot_gradient[k, 1] = -(c * sy + b * sx)
            slot_gradient[k, 2] = F(0.5) * sxx
            slot_gradient[k, 3] = sxy
            slot_gradient[k, 4] = F(0.5) * syy
            slot_gradient[k, 5] = -s / opacity
            slot_gradient[k, 6] = abs_x
            slot_gradient[k, 7] = abs_y
            slot_gradient[k, 8] = s_red
            slot_gradient[k, 9] = s_green
            slot_gradient[k, 10] = s_blue
            for e in range(extras):
                total = F(0)
                for x in range(TILE):
                    total += extra_sums[e, x]
                slot_gradient[k, SLOT_COLUMNS + 3 + e] = total
        for k in range(end[tile], offsets[tile + 1]):
            for j in range(SLOT_COLUMNS + 3 + extras):
                slot_gradient[k, j] = F(0)


@njit(parallel=True, cache=True, error_model="numpy")
def gather(first_slot: Ints, slots: Ints, slot_gradient: Floats, gradient: Floats):  # type: ignore[no-untyped-def]
    """Sum the slots of each Gaussian, in the order of its tiles: [M, D] -> [N, D]."""
    number, columns = gradient.shape
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
            for j in range(columns):
                gradient[i, j] = F(0)
            for q in range(first_slot[i], first_slot[i + 1]):
                k = slots[q]
                for j in range(columns):
                    gradient[i, j] += slot_gradient[k, j]


def tile_stride(tiles: int) -> int:
    """A step near the golden ratio of `tiles` and coprime to it."""
    step = max(1, round(tiles * GOLDEN))
    while math.gcd(step, tiles) != 1:
        step += 1
    return step
