"""Arithmetic on complex numbers whose parts are of an LLVM type."""

from typing import Any

from .instructions import Instructions
from .values import Complex, Number, parts


def negative(code: Instructions, kind: str, x: Number) -> Complex:
    """−x."""
    a, b = parts(x)
    return Complex(code.op("fneg", kind, a), code.op("fneg", kind, b))


def conjugate(code: Instructions, kind: str, x: Number) -> Complex:
    """The complex conjugate."""
    a, b = parts(x)
    return Complex(a, code.op("fneg", kind, b))


def size(code: Instructions, kind: str, x: Number) -> Any:
    """|x|."""
    return code.library("hypot", kind, *parts(x))


def added(code: Instructions, kind: str, x: Number, y: Number) -> Complex:
    """x + y."""
    (a, b), (c, d) = parts(x), parts(y)
    return Complex(code.op("fadd contract", kind, a, c), code.op("fadd contract", kind, b, d))


def subtracted(code: Instructions, kind: str, x: Number, y: Number) -> Complex:
    """x − y."""
    (a, b), (c, d) = parts(x), parts(y)
    return Complex(code.op("fsub contract", kind, a, c), code.op("fsub contract", kind, b, d))


def multiplied(code: Instructions, kind: str, x: Number, y: Number) -> Complex:
    """x y."""
    (a, b), (c, d) = parts(x), parts(y)
    times = lambda u, v: code.op("fmul contract", kind, u, v)
    return Complex(
        code.op("fsub contract", kind, times(a, c), times(b, d)),
        code.op("fadd contract", kind, times(a, d), times(b, c)),
    )


def divided(code: Instructions, kind: str, x: Number, y: Number) -> Complex:
    """By Smith's algorithm: no overflow in c² + d². What is not 0 is infinite by 0."""
    (a, b), (c, d) = parts(x), parts(y)
    absolute = lambda u: code.intrinsic("fabs", kind, u)
    wide = code.op("fcmp oge", kind, absolute(c), absolute(d), result="i1")
    big, small = code.select(wide, c, d, kind), code.select(wide, d, c, kind)
    ratio = code.op("fdiv", kind, small, big)
    # The sign of a zero shows in the sum below.
    zero = code.op("fcmp oeq", kind, big, 0.0, result="i1")
    ratio = code.select(zero, code.op("fneg", kind, small), ratio, kind)
    times = lambda u, v: code.op("fmul", kind, u, v)
    bottom = code.op("fadd", kind, big, times(small, ratio))
    u, v = code.select(wide, a, b, kind), code.select(wide, b, a, kind)
    real = code.op("fadd", kind, u, times(v, ratio))
    imag = code.op("fsub", kind, v, times(u, ratio))
    imag = code.select(wide, imag, code.op("fneg", kind, imag), kind)
    return Complex(code.op("fdiv", kind, real, bottom), code.op("fdiv", kind, imag, bottom))


OPERATIONS = {"add": added, "sub": subtracted, "mul": multiplied, "div": divided}
