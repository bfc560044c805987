"""Tiles of 32 x 32 pixels in blocks of 4 x 4, one vector of 16 lanes each, inside numba kernels.

A row of blocks is a byte of a number of 64 bits: the blocks that a Gaussian touches are one number.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from pipeline.kernels import helper, inlined
from stages.splatting.lanes.types import BIT, INT, INTS, WIDTH, as_lanes, int_lanes, lanes
from stages.splatting.lanes.vectors import (
    address_of,
    at_least,
    at_most,
    constant,
    count_up,
    intrinsic,
    load,
    root,
    scale_by_power,
    spread,
    store,
    to_float,
    truncate,
    vector_of,
    where,
)

F = np.float32

#: pixels along a tile, along a block, and blocks of a tile along a side and in all
TILE, BLOCK = 32, 4
SIDE = TILE // BLOCK
BLOCKS = SIDE * SIDE
#: numbers in a vector
LANES = WIDTH
#: px that an ellipse is widened by, against rounding
SAFETY = F(0.01)
#: first pixel of each block of a tile
BLOCK_X = (np.arange(BLOCKS) % SIDE * BLOCK).astype(np.float32)
BLOCK_Y = (np.arange(BLOCKS) // SIDE * BLOCK).astype(np.float32)


@intrinsic
def halves(typing_context, low, high):  # type: ignore[no-untyped-def]
    """`low` in lanes 0 to 7 and `high` in lanes 8 to 15."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        a, b = (as_lanes(context, builder, arguments[k], sig.args[k]) for k in (0, 1))
        order = [k if k < WIDTH // 2 else k + WIDTH for k in range(WIDTH)]
        return builder.shuffle_vector(a, b, ir.Constant(INTS, order))

    return lanes(low, high), generate


@intrinsic
def ranges_to_bits(typing_context, counts):  # type: ignore[no-untyped-def]
    """Eight ranges of bits as the eight bytes of one number.

    Byte k has its bits from 8 - counts[8 + k] up to, but without, counts[k]; counts are 0 to 8.
    """
    half = WIDTH // 2
    few = ir.VectorType(INT, half)
    wide = ir.VectorType(ir.IntType(64), half)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        undefined = ir.Constant(INTS, ir.Undefined)
        places = ir.VectorType(INT, half)
        ends, starts = (
            builder.shuffle_vector(
                arguments[0], undefined, ir.Constant(places, [first + k for k in range(half)])
            )
            for first in (0, half)
        )
        below = builder.sub(
            builder.shl(ir.Constant(few, [1] * half), ends), ir.Constant(few, [1] * half)
        )
        before = builder.lshr(ir.Constant(few, [255] * half), starts)
        chosen = builder.and_(below, builder.xor(before, ir.Constant(few, [255] * half)))
        moved = builder.shl(
            builder.zext(chosen, wide), ir.Constant(wide, [8 * k for k in range(half)])
        )
        kind = ir.FunctionType(ir.IntType(64), [wide])
        name = f"llvm.vector.reduce.or.v{half}i64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [moved])

    return types.int64(int_lanes), generate


@intrinsic
def lowest_bit(typing_context, bits):  # type: ignore[no-untyped-def]
    """Place of the lowest bit that is set; `bits` is not 0."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.Constant(BIT, 1))

    return types.int64(types.int64), generate


@intrinsic
def take_number(typing_context, counter):  # type: ignore[no-untyped-def]
    """counter[0], which is one more afterwards, for each thread another number."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        values = context.make_array(sig.args[0])(context, builder, arguments[0])
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", values.data, one, "monotonic")

    return types.int64(types.Array(types.int64, 1, "C")), generate


@intrinsic
def load_square(typing_context, array, index, stride):  # type: ignore[no-untyped-def]
    """4 x 4 items of a contiguous array, seen as one row: four from `index` on, four `stride`
    later, and so on."""
    kind, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        value, index, stride = arguments
        four = ir.VectorType(vector.element, 4)
        rows = []
        for _ in range(4):
            pointer = address_of(context, builder, sig.args[0], value, index, four)
            rows.append(builder.load(pointer, align=4))
            index = builder.add(index, stride)
        eight = ir.Constant(ir.VectorType(INT, 8), list(range(8)))
        top, bottom = (builder.shuffle_vector(rows[k], rows[k + 1], eight) for k in (0, 2))
        return builder.shuffle_vector(top, bottom, ir.Constant(INTS, list(range(WIDTH))))

    return kind(array, types.intp, types.intp), generate


@intrinsic
def store_square(typing_context, array, index, stride, value):  # type: ignore[no-untyped-def]
    """Put a vector where `load_square` would read it."""
    kind, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        target, index, stride, whole = arguments
        four = ir.VectorType(vector.element, 4)
        undefined = ir.Constant(vector, ir.Undefined)
        for row in range(4):
            places = ir.Constant(ir.VectorType(INT, 4), [4 * row + k for k in range(4)])
            part = builder.shuffle_vector(whole, undefined, places)
            pointer = address_of(context, builder, sig.args[0], target, index, four)
            builder.store(part, pointer, align=4)
            index = builder.add(index, stride)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, kind), generate


@inlined
def exp2(x, lowest, p0, p1, p2, p3, p4):  # type: ignore[no-untyped-def]
    """2^x for x <= 0, relative error 3e-6: minimax polynomial on (-1, 0] times a power of two.

    `lowest` and the coefficients as `exp2_constants` gives them.
    """
    x = at_least(x, lowest)
    whole = truncate(x)
    part = x - to_float(whole)
    return scale_by_power(p0 + part * (p1 + part * (p2 + part * (p3 + part * p4))), whole)


@inlined
def exp2_constants():  # type: ignore[no-untyped-def]
    return (
        constant(F(-126.0)), constant(F(0.99999741)), constant(F(0.69303020)),
        constant(F(0.23934107)), constant(F(0.053074066)), constant(F(0.0067670840)),
    )  # fmt: skip


@inlined
def pixels():  # type: ignore[no-untyped-def]
    """Column and row, in its block, of the pixel of each lane."""
    lane = count_up()
    row = to_float(truncate(lane * F(0.25)))
    return lane - row * F(4), row


@inlined
def touched_blocks(mx, my, e, slope, width, height, across, inverse_a):  # type: ignore[no-untyped-def]
    """The blocks of a tile that an ellipse touches, a bit each.

    Lanes 0 to 7 find for each row of blocks how far to the right the ellipse comes within it,
    lanes 8 to 15 how far to the left.

    Args:
        mx, my: its centre, relative to the first pixel of the tile.
        e, slope, inverse_a: 1 / variance along y, b / a, 1 / a.
        width, height: half its size.
        across: height above the centre of its rightmost point.
    """
    lane = count_up()
    one, eight = spread(F(1)), spread(F(8))
    sign = where(lane < eight, one, F(-1))
    top = (lane - where(lane < eight, spread(F(0)), eight)) * F(BLOCK) - my
    bottom = top + F(BLOCK - 1)
    touched = (top <= height + SAFETY) & (bottom >= -(height + SAFETY))
    y = at_most(at_least(sign * across, top), bottom)
    extent = root(at_least((height * height - y * y) * (e * inverse_a), F(0)))
    # in blocks; whole numbers where the last pixel of a row touches
    reach = ((mx - slope * y) * sign + extent + SAFETY) * F(1 / BLOCK)
    reach = reach + halves(F(1), F(SIDE + 1 - 1 / BLOCK))
    counts = truncate(at_most(at_least(reach, F(0)), F(SIDE)))
    return ranges_to_bits(where(touched, counts, 0))


@helper
def workspace(vectors):  # type: ignore[no-untyped-def]
    """Zeros [vectors, 16] that begin at a cache line: a vector across two lines costs double."""
    raw = np.zeros((vectors + 1) * LANES, np.float32)
    start = (-(raw.ctypes.data // 4)) % LANES
    return raw[start : start + vectors * LANES].reshape(vectors, LANES)


@helper
def read_tile(array, channel, x0, y0, state, first):  # type: ignore[no-untyped-def]
    """A tile of [C, H, W] as vectors of `state` from `first` on; 0 outside of the image."""
    height, width = array.shape[1], array.shape[2]
    for block in range(BLOCKS):
        x, y = x0 + block % SIDE * BLOCK, y0 + block // SIDE * BLOCK
        if x + BLOCK <= width and y + BLOCK <= height:
            index = (channel * height + y) * width + x
            store(state, first + block, load_square(array, index, width))
            continue
        for lane in range(LANES):
            u, v = x + lane % BLOCK, y + lane // BLOCK
            inside = u < width and v < height
            state[first + block, lane] = array[channel, v, u] if inside else 0


@helper
def write_tile(state, first, x0, y0, array, channel):  # type: ignore[no-untyped-def]
    """The opposite of `read_tile`."""
    height, width = array.shape[1], array.shape[2]
    for block in range(BLOCKS):
        x, y = x0 + block % SIDE * BLOCK, y0 + block // SIDE * BLOCK
        if x + BLOCK <= width and y + BLOCK <= height:
            index = (channel * height + y) * width + x
            store_square(array, index, width, load(state, first + block))
            continue
        for lane in range(LANES):
            u, v = x + lane % BLOCK, y + lane // BLOCK
            if u < width and v < height:
                array[channel, v, u] = state[first + block, lane]
