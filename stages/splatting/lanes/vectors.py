"""Sixteen numbers at a time inside a numba kernel: LLVM vectors as numba types.

LLVM's own vectoriser gives up on a loop for small reasons, at five times the cost, and keeps sums
in memory that fit into registers. With these types a kernel says itself what a vector is: one
`Lanes` is one register with AVX-512, two with AVX2, four with NEON.

    a = load(row, 0)                 # Lanes from a float32 array [..., 16], last axis contiguous
    b = where(a > 0, a * 2, a)       # operators with Lanes and with scalars
    store(row, 0, a + b)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic as _intrinsic

from pipeline.kernels import inlined
from stages.splatting.lanes.types import (
    FLOAT,
    FLOATS,
    INT,
    INTS,
    WIDTH,
    IntLanes,
    Lanes,
    as_int_lanes,
    as_lanes,
    int_lanes,
    lanes,
    mask_lanes,
    spread_value,
)

F = np.float32

#: untyped: inside a kernel these functions have other arguments than here
intrinsic: Any = _intrinsic


def address_of(context: Any, builder: Any, kind: Any, value: Any, index: Any, vector: Any) -> Any:
    """Pointer to the vector that begins at item `index` of an array seen as one row."""
    array = context.make_array(kind)(context, builder, value)
    return builder.bitcast(builder.gep(array.data, [index]), vector.as_pointer())


def vector_of(kind: Any) -> tuple[Any, Any]:
    if isinstance(kind, types.Array) and kind.layout == "C":
        if kind.dtype == types.float32:
            return lanes, FLOATS
        if kind.dtype == types.int32:
            return int_lanes, INTS
    raise TypeError(f"lanes are of contiguous arrays of float32 or int32, not of {kind}")


@intrinsic
def load_from(typing_context, array, index):  # type: ignore[no-untyped-def]
    """16 items of a contiguous array, seen as one row, from `index` on; no bounds check."""
    kind, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        value, index = arguments
        pointer = address_of(context, builder, sig.args[0], value, index, vector)
        return builder.load(pointer, align=4)

    return kind(array, types.intp), generate


@intrinsic
def store_from(typing_context, array, index, value):  # type: ignore[no-untyped-def]
    """Put a vector where `load_from` would read it."""
    kind, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        target, index, lanes_value = arguments
        pointer = address_of(context, builder, sig.args[0], target, index, vector)
        builder.store(lanes_value, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, kind), generate


@inlined
def load(array, row):  # type: ignore[no-untyped-def]
    """Vector number `row` of a contiguous array that is seen as [n, 16]; no bounds check."""
    return load_from(array, row * WIDTH)


@inlined
def store(array, row, value):  # type: ignore[no-untyped-def]
    """Put a vector where `load` would read it."""
    store_from(array, row * WIDTH, value)


@intrinsic
def spread(typing_context, value):  # type: ignore[no-untyped-def]
    """A number in every lane."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return as_lanes(context, builder, arguments[0], sig.args[0])

    return lanes(value), generate


@intrinsic
def constant(typing_context, value):  # type: ignore[no-untyped-def]
    """A number in every lane that LLVM does not know to be constant.

    It keeps such a vector in a register; a known one it reads from memory at every use, which takes
    two instructions more in code that is compiled on the spot.
    """

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        number = context.cast(builder, arguments[0], sig.args[0], types.float32)
        bits = builder.bitcast(number, INT)
        kind = ir.FunctionType(INT, [INT])
        hidden = builder.asm(kind, "", "=r,0", [bits], side_effect=True)
        return spread_value(builder, builder.bitcast(hidden, FLOAT), FLOATS)

    return lanes(value), generate


@intrinsic
def item(typing_context, array, index):  # type: ignore[no-untyped-def]
    """array[index] of a contiguous array seen as one row, for an index that is not negative."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        values = context.make_array(sig.args[0])(context, builder, arguments[0])
        return builder.load(builder.gep(values.data, [arguments[1]]))

    return array.dtype(array, types.intp), generate


@intrinsic
def prefetch(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Have the cache line of array[index] (seen as one row) brought in."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        values = context.make_array(sig.args[0])(context, builder, arguments[0])
        byte = ir.IntType(8).as_pointer()
        pointer = builder.bitcast(builder.gep(values.data, [arguments[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        # to read, used again, data
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@intrinsic
def count_up(typing_context):  # type: ignore[no-untyped-def]
    """0, 1, ... 15."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return ir.Constant(FLOATS, [float(k) for k in range(WIDTH)])

    return lanes(), generate


@intrinsic
def where(typing_context, mask, yes, no):  # type: ignore[no-untyped-def]
    """Lane by lane; one of `yes` and `no` may be a number."""
    kind = yes if isinstance(yes, (Lanes, IntLanes)) else no
    convert = as_lanes if isinstance(kind, Lanes) else as_int_lanes

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        a, b = (convert(context, builder, arguments[k], sig.args[k]) for k in (1, 2))
        return builder.select(arguments[0], a, b)

    return kind(mask, yes, no), generate


@intrinsic
def at_most(typing_context, value, limit):  # type: ignore[no-untyped-def]
    """The smaller of a vector and a number or vector; not a number becomes `limit`."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bound = as_lanes(context, builder, arguments[1], sig.args[1])
        return builder.select(builder.fcmp_ordered("<", arguments[0], bound), arguments[0], bound)

    return lanes(lanes, limit), generate


@intrinsic
def at_least(typing_context, value, limit):  # type: ignore[no-untyped-def]
    """The larger of a vector and a number or vector; not a number becomes `limit`."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bound = as_lanes(context, builder, arguments[1], sig.args[1])
        return builder.select(builder.fcmp_ordered(">", arguments[0], bound), arguments[0], bound)

    return lanes(lanes, limit), generate


@intrinsic
def absolute(typing_context, value):  # type: ignore[no-untyped-def]
    """|x|."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(arguments[0], INTS)
        rest = ir.Constant(INTS, [0x7FFFFFFF] * WIDTH)
        return builder.bitcast(builder.and_(bits, rest), FLOATS)

    return lanes(lanes), generate


@intrinsic
def truncate(typing_context, value):  # type: ignore[no-untyped-def]
    """float32 to int32, towards zero."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.fptosi(arguments[0], INTS)

    return int_lanes(lanes), generate


@intrinsic
def minus(typing_context, value):  # type: ignore[no-untyped-def]
    """-x of integers."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.sub(ir.Constant(INTS, [0] * WIDTH), arguments[0])

    return int_lanes(int_lanes), generate


@intrinsic
def to_float(typing_context, value):  # type: ignore[no-untyped-def]
    """int32 to float32."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.sitofp(arguments[0], FLOATS)

    return lanes(int_lanes), generate


@intrinsic
def scale_by_power(typing_context, value, exponent):  # type: ignore[no-untyped-def]
    """value * 2^exponent for normal numbers whose product is one."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        shift = ir.Constant(INTS, [23] * WIDTH)
        bits = builder.bitcast(arguments[0], INTS)
        moved = builder.add(bits, builder.shl(arguments[1], shift))
        return builder.bitcast(moved, FLOATS)

    return lanes(lanes, int_lanes), generate


@intrinsic
def any_of(typing_context, mask):  # type: ignore[no-untyped-def]
    """Is any lane true?"""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.IntType(WIDTH)(0))

    return types.boolean(mask_lanes), generate


@intrinsic
def largest(typing_context, value):  # type: ignore[no-untyped-def]
    """The largest of 16 integers."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(INT, [INTS])
        name = f"llvm.vector.reduce.smax.v{WIDTH}i32"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return types.int32(int_lanes), generate


@intrinsic
def root(typing_context, value):  # type: ignore[no-untyped-def]
    """Square root."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(FLOATS, [FLOATS])
        name = f"llvm.sqrt.v{WIDTH}f32"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return lanes(lanes), generate


@intrinsic
def sums(typing_context, vectors):  # type: ignore[no-untyped-def]
    """The sums of 16 vectors in the 16 lanes of one, by a tree of shuffles: a fixed order."""
    if not isinstance(vectors, types.UniTuple) or vectors.count != WIDTH:
        raise TypeError(f"sums wants a tuple of {WIDTH} Lanes, not {vectors}")

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        rows = [builder.extract_value(arguments[0], k) for k in range(WIDTH)]
        # each round halves the rows: lane k and k ^ span of one row meet; rows a and b share a row
        span = WIDTH // 2
        while len(rows) > 1:
            half = len(rows) // 2
            low = [k if not k & span else k - span + WIDTH for k in range(WIDTH)]
            high = [k + span if not k & span else k + WIDTH for k in range(WIDTH)]
            rows = [
                builder.fadd(
                    builder.shuffle_vector(a, b, ir.Constant(INTS, low)),
                    builder.shuffle_vector(a, b, ir.Constant(INTS, high)),
                )
                for a, b in zip(rows[:half], rows[half:], strict=True)
            ]
            span //= 2
        return rows[0]

    return lanes(vectors), generate


@inlined
def exponential(x):  # type: ignore[no-untyped-def]
    """e^x, relative error below 5e-6 (5e-7 for |x| < 10), held between 1e-38 and 1e38.

    What is not finite gives not a number.
    """
    zero_or_nan = x * F(0)
    x = at_most(at_least(x * F(1.44269504), F(-126.0)), F(126.0))
    # the nearest whole number: truncate rounds towards 0
    whole = truncate(x + where(x > F(0), spread(F(0.5)), F(-0.5)))
    part = (x - to_float(whole)) * F(0.693147181)
    series = F(1 / 120) + part * (F(1 / 720) + part * F(1 / 5040))
    series = F(0.5) + part * (F(1 / 6) + part * (F(1 / 24) + part * series))
    return scale_by_power(F(1) + part * (F(1) + part * series), whole) + zero_or_nan


@intrinsic
def power_of(typing_context, value):  # type: ignore[no-untyped-def]
    """The whole number n for which a positive value lies between 0.707 and 1.414 times 2^n."""

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(arguments[0], INTS)
        from_root = builder.sub(bits, ir.Constant(INTS, [0x3F3504F3] * WIDTH))
        return builder.ashr(from_root, ir.Constant(INTS, [23] * WIDTH))

    return int_lanes(lanes), generate


@inlined
def log2(x):  # type: ignore[no-untyped-def]
    """Logarithm to base 2 of positive numbers, to float32's precision."""
    power = power_of(x)
    part = scale_by_power(x, minus(power))
    ratio = (part - F(1)) / (part + F(1))
    square = ratio * ratio
    series = F(1 / 3) + square * (F(1 / 5) + square * (F(1 / 7) + square * F(1 / 9)))
    return to_float(power) + F(2.88539008) * (ratio + ratio * square * series)
