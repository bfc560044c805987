"""The numba types behind `lanes`: LLVM vectors of 16 numbers, and their operators."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

WIDTH = 16

FLOAT, INT, BIT = ir.FloatType(), ir.IntType(32), ir.IntType(1)
FLOATS, INTS = ir.VectorType(FLOAT, WIDTH), ir.VectorType(INT, WIDTH)
BITS = ir.VectorType(BIT, WIDTH)
#: a product and a sum may be fused; not a number stays not a number
_FLAGS = ("contract",)


class Lanes(types.Type):
    """16 float32."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


class IntLanes(types.Type):
    """16 int32."""

    def __init__(self) -> None:
        super().__init__(name="IntLanes")


class MaskLanes(types.Type):
    """16 truth values."""

    def __init__(self) -> None:
        super().__init__(name="MaskLanes")


lanes, int_lanes, mask_lanes = Lanes(), IntLanes(), MaskLanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, FLOATS)


@register_model(IntLanes)
class _IntLanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, INTS)


@register_model(MaskLanes)
class _MaskLanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


def spread_value(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    """A scalar in every lane."""
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, INT(0))
    zeros = ir.Constant(ir.VectorType(INT, WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def as_lanes(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    if isinstance(kind, Lanes):
        return value
    return spread_value(builder, context.cast(builder, value, kind, types.float32), FLOATS)


def as_int_lanes(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    if isinstance(kind, IntLanes):
        return value
    return spread_value(builder, context.cast(builder, value, kind, types.int32), INTS)


def _define_operator(function: Any, result: Any, of: Any, build: Callable[..., Any]) -> None:
    """`function` of two vectors of kind `of`, or of one and a scalar."""
    convert = as_lanes if of is lanes else as_int_lanes
    allowed = types.Number if of is lanes else types.Integer

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            if len(arguments) != 2 or of not in arguments:
                return None
            if all(a == of or isinstance(a, allowed) for a in arguments):
                return signature(result, *arguments)
            return None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        a, b = (
            convert(context, builder, value, kind)
            for value, kind in zip(arguments, sig.args, strict=True)
        )
        return build(builder, a, b)

    for left, right in ((type(of), type(of)), (type(of), allowed), (allowed, type(of))):
        lower_builtin(function, left, right)(lower)


def _compare(symbol: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.fcmp_ordered(symbol, a, b)


def _compare_ints(symbol: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.icmp_signed(symbol, a, b)


for _function, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"),
                         (operator.truediv, "fdiv")):  # fmt: skip
    _define_operator(
        _function, lanes, lanes,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=_FLAGS),
    )  # fmt: skip
for _function, _name in ((operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul")):
    _define_operator(
        _function, lanes, lanes,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=_FLAGS),
    )  # fmt: skip
for _function, _symbol in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"),
                           (operator.ge, ">=")):  # fmt: skip
    _define_operator(_function, mask_lanes, lanes, _compare(_symbol))
    _define_operator(_function, mask_lanes, int_lanes, _compare_ints(_symbol))


@infer_global(operator.and_)
class _AndTemplate(AbstractTemplate):
    def generic(self, arguments: Any, keywords: Any) -> Any:
        if tuple(arguments) == (mask_lanes, mask_lanes):
            return signature(mask_lanes, *arguments)
        return None


@lower_builtin(operator.and_, MaskLanes, MaskLanes)
def _lower_and(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    return builder.and_(*arguments)
