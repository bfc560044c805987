"""More of what `lanes` has, for rows of an image: parts of vectors at its edges, and windows."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from stages.splatting.lanes.types import FLOATS, INT, INTS, WIDTH, lanes, spread_value
from stages.splatting.lanes.vectors import address_of, intrinsic, vector_of


def _lanes_between(context: Any, builder: Any, low: Any, high: Any) -> Any:
    """Mask of the lanes from `low` up to, but without, `high`."""
    count = ir.Constant(INTS, list(range(WIDTH)))
    first, after = (spread_value(builder, builder.trunc(x, INT), INTS) for x in (low, high))
    return builder.and_(
        builder.icmp_signed(">=", count, first), builder.icmp_signed("<", count, after)
    )


@intrinsic
def load_part(typing_context, array, index, low, high):  # type: ignore[no-untyped-def]
    """`load_from`, but only the lanes from `low` up to `high` are read; 0 in the others."""
    _, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        value, index, low, high = arguments
        pointer = address_of(context, builder, sig.args[0], value, index, vector)
        chosen = _lanes_between(context, builder, low, high)
        kind = ir.FunctionType(FLOATS, [pointer.type, INT, chosen.type, FLOATS])
        name = f"llvm.masked.load.v{WIDTH}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [pointer, INT(4), chosen, ir.Constant(FLOATS, [0.0] * WIDTH)])

    return lanes(array, types.intp, types.intp, types.intp), generate


@intrinsic
def store_part(typing_context, array, index, value, high):  # type: ignore[no-untyped-def]
    """`store_from`, but only the lanes up to `high` are written."""
    _, vector = vector_of(array)

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        target, index, whole, high = arguments
        pointer = address_of(context, builder, sig.args[0], target, index, vector)
        chosen = _lanes_between(context, builder, ir.Constant(ir.IntType(64), 0), high)
        kind = ir.FunctionType(ir.VoidType(), [FLOATS, pointer.type, INT, chosen.type])
        name = f"llvm.masked.store.v{WIDTH}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(function, [whole, pointer, INT(4), chosen])
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes, types.intp), generate


@intrinsic
def windowed(typing_context, first, second, weights):  # type: ignore[no-untyped-def]
    """A window with the 2 n + 1 symmetric `weights` (n + 1 vectors, the middle last) over the
    row of numbers that two vectors are; its first 16 sums."""
    taps = weights.count

    def generate(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        row = [
            builder.shuffle_vector(
                arguments[0], arguments[1], ir.Constant(INTS, [k + j for j in range(WIDTH)])
            )
            for k in range(2 * taps - 1)
        ]
        weight = [builder.extract_value(arguments[2], k) for k in range(taps)]
        total = builder.fmul(row[taps - 1], weight[taps - 1], flags=("contract",))
        for k in range(taps - 1):
            pair = builder.fadd(row[k], row[2 * taps - 2 - k], flags=("contract",))
            part = builder.fmul(pair, weight[k], flags=("contract",))
            total = builder.fadd(total, part, flags=("contract",))
        return total

    return lanes(first, second, weights), generate
