"""Rules of primitives on the bits of floating-point numbers."""

from typing import Any

import numpy as np

from ...types import Equation
from ..arithmetic import compared
from ..context import Context
from ..dtypes import BYTES, FLOATS, INTEGERS, REALS, kind_of
from ..entrywise import entrywise
from ..instructions import Instructions
from ..values import Number, Value


def _bits(code: Instructions, x: Number, kind: str) -> Value:
    return code.cast("bitcast", code.copy(x, kind), f"i{8 * BYTES[kind]}")


def _same_width(eqn: Equation) -> str | None:
    widths = [np.dtype(v.aval.dtype).itemsize for v in (eqn.invars[0], eqn.outvars[0])]
    same = widths[0] == widths[1] and np.dtype(eqn.outvars[0].aval.dtype).name in REALS
    return None if same else "`bitcast_convert_type` between numbers of different widths is not written"


@entrywise("bitcast_convert_type", REALS, requires=_same_width)
def bitcast_convert_type(context: Context, x: Number, **_: object) -> Any:
    """The same bits as a number of another type."""
    if not isinstance(x, Value):
        return np.asarray(x, context.dtype).view(context.to)[()]
    kind = kind_of(context.to)
    return x if x.kind == kind else context.code.cast("bitcast", x, kind)


@entrywise("eq_to lt_to le_to", FLOATS | INTEGERS)
def total_order(context: Context, a: Number, b: Number, **_: object) -> Value:
    """Comparisons in which −0 comes before 0, and NaN by its sign before or after all others."""
    code, name, dtype = context.code, context.name.removesuffix("_to"), context.dtype
    if dtype.kind != "f":
        return compared(code, name, dtype, a, b)
    kind = kind_of(dtype)
    integer = f"i{8 * BYTES[kind]}"

    def ordered(x: Number) -> Value:
        """Integers in the order of the floats: of negative ones all bits but the sign the other way."""
        bits = _bits(code, x, kind)
        sign = code.op("ashr", integer, bits, 8 * BYTES[kind] - 1)
        return code.op("xor", integer, bits, code.op("lshr", integer, sign, 1))

    return code.op(f"icmp {'eq' if name == 'eq' else 's' + name}", integer, ordered(a), ordered(b), result="i1")


def _has_mantissa(eqn: Equation) -> str | None:
    return None if eqn.params["mantissa_bits"] > 0 else "`reduce_precision` to no bits of the mantissa is not written"


@entrywise("reduce_precision", FLOATS, requires=_has_mantissa)
def reduce_precision(context: Context, x: Number, *, exponent_bits: int, mantissa_bits: int) -> Any:
    """The nearest number of fewer bits, halves to even; what is too large is infinite, what is too small 0."""
    code, kind, info = context.code, kind_of(context.dtype), np.finfo(context.dtype.name)
    integer, nmant, nexp = f"i{info.bits}", info.nmant, info.bits - info.nmant - 1
    x = code.copy(x, kind)
    bits = _bits(code, x, kind)
    sign = code.op("and", integer, bits, -(1 << (info.bits - 1)))
    if mantissa_bits < nmant:
        dropped = nmant - mantissa_bits
        odd = code.op("and", integer, code.op("lshr", integer, bits, dropped), 1)
        rounded = code.op("add", integer, bits, code.op("add", integer, odd, (1 << (dropped - 1)) - 1))
        bits = code.op("and", integer, rounded, -(1 << dropped))
    if exponent_bits < nexp:
        bias, reduced = (1 << (nexp - 1)) - 1, (1 << (exponent_bits - 1)) - 1
        infinite = ((1 << nexp) - 1) << nmant
        exponent = code.op("and", integer, bits, infinite)
        too_large = code.op("icmp ugt", integer, exponent, (bias + reduced) << nmant, result="i1")
        too_small = code.op("icmp ule", integer, exponent, (bias - reduced) << nmant, result="i1")
        bits = code.select(too_large, code.op("or", integer, sign, infinite), bits, integer)
        bits = code.select(too_small, sign, bits, integer)
    undefined = code.op("fcmp uno", kind, x, x, result="i1")
    return code.select(undefined, x, code.cast("bitcast", bits, kind), kind)
