"""Maxima, minima and absolute values of floats."""

from typing import Any

import numpy as np

from .instructions import Instructions
from .values import Value


def absolute(code: Instructions, kind: str, x: Any) -> Value:
    """|x|."""
    found = code.intrinsic("fabs", kind, x)
    code.without_sign.add(found.name)
    return found


def extremum(code: Instructions, name: str, kind: str, a: Any, b: Any) -> Any:
    """`maximum` or `minimum` of two floats: NaN where one is, and 0 above −0."""
    if kind == "float" or code.target is None or not code.target.is_gpu:
        return code.intrinsic(name, kind, a, b)
    # Of doubles a GPU has neither: LLVM makes ten instructions of one.
    if name == "maximum" and _is_without_sign(code, a) and _is_without_sign(code, b):
        return _by_bits(code, kind, a, b)
    value, number = (b, a) if isinstance(b, Value) else (a, b)
    if isinstance(number, Value) or np.isnan(number):
        found = code.intrinsic(name.replace("imum", "num"), kind, a, b)
        return code.select(code.op("fcmp uno", kind, a, b, result="i1"), np.nan, found, kind)
    # Numbers that are equal may be zeros of both signs.
    of_equal = value if bool(np.signbit(number)) == (name == "maximum") else number
    order = ("ugt", "uge") if name == "maximum" else ("ult", "ule")
    wins = code.op(f"fcmp {order[of_equal is value]}", kind, value, number, result="i1")
    return code.select(wins, value, number, kind)


def _is_without_sign(code: Instructions, x: Any) -> bool:
    return x.name in code.without_sign if isinstance(x, Value) else not np.signbit(x)


def _by_bits(code: Instructions, kind: str, a: Any, b: Any) -> Value:
    """The maximum of doubles without a sign, which are ordered as their bits are, NaN above all."""
    bits = [code.cast("bitcast", x, "i64") if isinstance(x, Value) else np.float64(x).view(np.int64) for x in (a, b)]
    found = code.cast("bitcast", code.intrinsic("umax", "i64", *bits), kind)
    code.without_sign.add(found.name)
    return found
