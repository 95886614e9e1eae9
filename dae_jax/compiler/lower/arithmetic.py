"""Arithmetic on two numbers of a type as instructions: what the rules of primitives are made of."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..jaxprs.numbers import converted
from ..jaxprs.objects import is_number
from . import complex_arithmetic
from .dtypes import BYTES, is_signed, kind_of, part
from .extrema import absolute, extremum
from .instructions import Instructions
from .values import Complex, Number, Value, parts


_OF_FLOATS = {"add": "fadd contract", "sub": "fsub contract", "mul": "fmul contract", "div": "fdiv"}
_OF_TRUTH_VALUES = {"add": "or", "mul": "and", "max": "or", "min": "and"}
_COMPARISONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_KNOWN = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "and": np.bitwise_and,
    "or": np.bitwise_or, "xor": np.bitwise_xor, "logaddexp": np.logaddexp,
}  # fmt: skip


def applied(code: Instructions, name: str, dtype: np.dtype, a: Number, b: Number) -> Any:
    """`add`, `sub`, `mul`, `div`, `rem`, `max`, `min`, `and`, `or` and `xor` of two numbers of a type."""
    if dtype.kind == "c":
        return complex_arithmetic.OPERATIONS[name](code, kind_of(part(dtype)), a, b)
    kind = kind_of(dtype)
    if name == "logaddexp":
        return _log_of_sum(code, kind, a, b)
    if kind == "i1":
        name = _OF_TRUTH_VALUES.get(name, name)
    if name in ("max", "min"):
        if dtype.kind == "f":
            return extremum(code, name + "imum", kind, a, b)
        return code.intrinsic(("s" if is_signed(dtype) else "u") + name, kind, a, b)
    if dtype.kind == "f":
        # Not by an instruction, since there are machines on which that rounds the quotient.
        return code.library("fmod", kind, a, b) if name == "rem" else _of_floats(code, name, kind, a, b)
    if name in ("div", "rem"):
        return _quotient(code, name, dtype, a, b)
    return code.op(name, kind, a, b)


def combined(code: Instructions, name: str, dtype: np.dtype, a: Number, b: Number) -> Any:
    """The same of numbers that may be known both, by `logaddexp` too; `div` and `rem` are not."""
    if is_number(a) and is_number(b):
        with np.errstate(all="ignore"):
            return _KNOWN[name](a, b)
    return applied(code, name, dtype, a, b)


def total(code: Instructions, dtype: np.dtype, a: Number, b: Number) -> Any:
    """The sum; nothing is written for a known 0."""
    return b if is_number(a, 0) else a if is_number(b, 0) else combined(code, "add", dtype, a, b)


def _of_floats(code: Instructions, name: str, kind: str, a: Number, b: Number) -> Value:
    if name == "add" and a is b and isinstance(a, Value):
        return code.scaled(a, 2.0, kind)
    if name in ("mul", "div"):
        value, number = (b, a) if name == "mul" and isinstance(b, Value) else (a, b)
        if isinstance(value, Value) and not isinstance(number, Value | Complex) and _is_power_of_two(float(number)):
            return code.scaled(value, float(number) if name == "mul" else 1 / float(number), kind)
    return code.op(_OF_FLOATS[name], kind, a, b)


def _log_of_sum(code: Instructions, kind: str, a: Number, b: Number) -> Value:
    """log(eᵃ + eᵇ)."""
    largest = extremum(code, "maximum", kind, a, b)
    apart = absolute(code, kind, code.op("fsub", kind, a, b))
    more = code.library("log1p", kind, code.library("exp", kind, code.op("fneg", kind, apart)))
    # Of two infinities of one sign the difference is none.
    undefined = code.op("fcmp uno", kind, apart, apart, result="i1")
    return code.select(undefined, code.op("fadd", kind, a, b), code.op("fadd", kind, largest, more), kind)


def _quotient(code: Instructions, name: str, dtype: np.dtype, a: Number, b: Number) -> Value:
    # The processor traps at x/0 and at −2^(n−1)/−1; XLA gives −1 (x for the remainder) and the number itself (0).
    kind, signed = kind_of(dtype), is_signed(dtype)
    instruction = f"{'s' if signed else 'u'}{name}"
    if not isinstance(b, Value) and b not in (0, -1):
        return code.op(instruction, kind, a, b)
    by_none, harmless = compared(code, "eq", dtype, b, 0), b
    by_minus = compared(code, "eq", dtype, b, -1) if signed else None
    for trap in (by_none, by_minus):
        harmless = code.select(trap, 1, harmless, kind) if trap else harmless
    out = code.op(instruction, kind, a, harmless)
    if by_minus:
        out = code.select(by_minus, code.op("sub", kind, 0, a) if name == "div" else 0, out, kind)
    return code.select(by_none, -1 if name == "div" else a, out, kind)


def compared(code: Instructions, name: str, dtype: np.dtype, a: Number, b: Number) -> Value:
    """`eq`, `ne`, `lt`, `le`, `gt` and `ge` of two real numbers of a type."""
    if dtype.kind == "f":
        return code.op(f"fcmp {_COMPARISONS[name]}", kind_of(dtype), a, b, result="i1")
    signed = "" if name in ("eq", "ne") else "s" if is_signed(dtype) else "u"
    return code.op(f"icmp {signed}{name}", kind_of(dtype), a, b, result="i1")


def convert(code: Instructions, x: Number, dtype: np.dtype, to: np.dtype) -> Any:
    """A number of one type as one of another."""
    if dtype == to:
        return x
    if to.kind == "c":
        half, (real, imag) = part(to), parts(x)
        return Complex(convert(code, real, part(dtype), half), convert(code, imag, part(dtype), half))
    if dtype.kind == "c":
        return convert(code, parts(x)[0], part(dtype), to)
    if not isinstance(x, Value):
        assert not isinstance(x, Complex)
        return converted(x, to)
    a, b = kind_of(dtype), kind_of(to)
    if a == b:
        return x
    if b == "i1":
        return compared(code, "ne", dtype, x, 0)
    if dtype.kind == "f":
        return (
            code.cast("fptrunc" if BYTES[b] < BYTES[a] else "fpext", x, b) if to.kind == "f" else _rounded(code, x, to)
        )
    if to.kind == "f":
        return code.cast("sitofp" if is_signed(dtype) else "uitofp", x, b)
    return code.cast("trunc" if BYTES[b] < BYTES[a] else "sext" if is_signed(dtype) else "zext", x, b)


def _rounded(code: Instructions, x: Value, to: np.dtype) -> Value:
    """A float towards zero, to the nearest integer there is; NaN to 0."""
    kind, function = kind_of(to), f"llvm.{'fptosi' if is_signed(to) else 'fptoui'}.sat"
    names = [f"v{code.width}{n}" if x.lanes else n for n in (kind, {"double": "f64", "float": "f32"}[x.kind])]
    result, operand = code.type(kind, x.lanes), code.type(x.kind, x.lanes)
    full = code.function(f"{function}.{'.'.join(names)}", result, operand)
    return code.pure(f"call {result} {full}({operand} {x.name})", kind, x.lanes)


def power(code: Instructions, x: Number, exponent: int, dtype: np.dtype) -> Any:
    """A whole power, by squares."""
    n, out = abs(exponent), None
    while n:
        if n & 1:
            out = x if out is None else applied(code, "mul", dtype, out, x)
        n >>= 1
        x = applied(code, "mul", dtype, x, x) if n else x
    one = dtype.type(1)
    if out is None:
        return one
    return applied(code, "div", dtype, one, out) if exponent < 0 else out


def better(
    code: Instructions, name: str, dtype: np.dtype, to: np.dtype, found: Sequence[Number], other: Sequence[Number]
) -> tuple[Any, Any]:
    """Of two numbers with their places the one that `argmax` or `argmin` looks for; the first that is undefined."""
    kind, (best, place), (y, there) = kind_of(dtype), found, other
    wins = compared(code, "gt" if name == "argmax" else "lt", dtype, y, best)
    if dtype.kind == "f":
        undefined = code.op("fcmp uno", kind, y, y, result="i1")
        known = code.op("fcmp ord", kind, best, best, result="i1")
        wins = code.op("and", "i1", known, code.op("or", "i1", undefined, wins))
    return code.select(wins, y, best, kind), code.select(wins, there, place, kind_of(to))


def identity(name: str, dtype: np.dtype) -> Any:
    """The number that changes nothing."""
    if name in ("add", "or", "xor"):
        return dtype.type(0)
    if name in ("mul", "and"):
        return dtype.type(1) if name == "mul" else ~dtype.type(0)
    if dtype.kind == "b":
        return dtype.type(name == "min")
    if dtype.kind == "f":
        return dtype.type(-np.inf if name == "max" else np.inf)
    info = np.iinfo(dtype)
    return dtype.type(info.min if name == "max" else info.max)


def _is_power_of_two(x: float) -> bool:
    return x > 0 and math.frexp(x)[0] == 0.5 and 1e-30 < x < 1e30
