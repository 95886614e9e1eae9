"""Rules of primitives on real floating-point numbers."""

from typing import Any

import jax
import numpy as np

from ...emit.vector_math import has_symbol
from ...types import Equation
from ..arithmetic import convert
from ..context import Context
from ..dtypes import BYTES, FLOATS, INTEGERS, kind_of
from ..entrywise import entrywise
from ..instructions import Instructions
from ..values import Number, Value


_INTRINSICS = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil"}
_ROOTS = {0.5: 1, 0.25: 2, 0.125: 3}


def _in_library(eqn: Equation) -> str | None:
    name = f"{eqn.primitive.name}{'f' if eqn.outvars[0].aval.dtype == np.float32 else ''}"
    return None if has_symbol(name) else f"the C library has no {name}"


@entrywise(
    "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p cbrt erf erfc atan2 lgamma",
    FLOATS, requires=_in_library,
)  # fmt: skip
def library(context: Context, *x: Any, **_: object) -> Value:
    """A function of the C library's."""
    return context.code.library(context.name, kind_of(context.dtype), *x)


@entrywise("sqrt floor ceil", FLOATS)
def intrinsic(context: Context, x: Number, **_: object) -> Value:
    """An instruction of the machine's."""
    return context.code.intrinsic(_INTRINSICS[context.name], kind_of(context.dtype), x)


@entrywise("rsqrt", FLOATS)
def rsqrt(context: Context, x: Number, **_: object) -> Value:
    """1/√x."""
    kind = kind_of(context.dtype)
    return context.code.op("fdiv", kind, 1.0, context.code.intrinsic("sqrt", kind, x))


@entrywise("pow", (FLOATS, FLOATS | INTEGERS), requires=_in_library)
def pow_(context: Context, x: Number, y: Number, **_: object) -> Any:
    """x to the power of a real or a whole number."""
    code, kind = context.code, kind_of(context.to)
    y = convert(code, y, context.dtype, context.to)
    if isinstance(y, np.floating) and y in _ROOTS:
        return _root(code, x, _ROOTS[float(y)], kind)
    return code.library("pow", kind, x, y)


def _root(code: Instructions, x: Number, times: int, kind: str) -> Value:
    """The square root of the square root …; of −0 and −∞ as a power has it."""
    x = code.select(code.op("fcmp oeq", kind, x, -np.inf, result="i1"), np.inf, x, kind)
    x = code.op("fadd", kind, x, 0.0)
    for _ in range(times):
        x = code.intrinsic("sqrt", kind, x)
    return x


@entrywise("logistic", FLOATS)
def logistic(context: Context, x: Number, **_: object) -> Value:
    """1/(1 + e⁻ˣ)."""
    code, kind = context.code, kind_of(context.dtype)
    grown = code.library("exp", kind, code.op("fneg", kind, x))
    return code.op("fdiv", kind, 1.0, code.op("fadd", kind, 1.0, grown))


@entrywise("round", FLOATS)
def rounded(context: Context, x: Number, *, rounding_method: jax.lax.RoundingMethod, **_: object) -> Value:
    """The nearest whole number; halves away from zero, or to even ones."""
    name = "round" if int(rounding_method) == 0 else "roundeven"
    return context.code.intrinsic(name, kind_of(context.dtype), x)


@entrywise("is_finite", FLOATS)
def is_finite(context: Context, x: Number, **_: object) -> Value:
    """Whether it is neither infinite nor NaN."""
    kind = kind_of(context.dtype)
    return context.code.op("fcmp olt", kind, context.code.intrinsic("fabs", kind, x), np.inf, result="i1")


@entrywise("nextafter", FLOATS)
def nextafter(context: Context, x: Number, y: Number, **_: object) -> Any:
    """The next number from x towards y. Compared as integers, where the smallest numbers are no zeros as they are to XLA's threads."""
    code, kind = context.code, kind_of(context.dtype)
    bits = 8 * BYTES[kind]
    integer = f"i{bits}"
    x, y = (code.copy(z, kind) for z in (x, y))
    of_x, of_y = (code.cast("bitcast", z, integer) for z in (x, y))
    below = lambda a, b: code.op("icmp slt", integer, a, b, result="i1")
    # The order of the numbers: of negative ones, and of −0, it is the other way round.
    place = lambda z: code.select(below(z, 0), code.op("sub", integer, -(2 ** (bits - 1)), z), z, integer)
    a, b = place(of_x), place(of_y)
    step = code.select(code.op("xor", "i1", below(a, b), below(of_x, 0)), 1, -1, integer)
    from_zero = code.select(below(a, b), 1, 1 - 2 ** (bits - 1), integer)
    is_zero, same = (code.op("icmp eq", integer, a, z, result="i1") for z in (0, b))
    moved = code.select(is_zero, from_zero, code.op("add", integer, of_x, step), integer)
    moved = code.cast("bitcast", moved, kind)
    undefined = code.op("fcmp uno", kind, x, y, result="i1")
    return code.select(undefined, code.op("fadd", kind, x, y), code.select(same, y, moved, kind), kind)
