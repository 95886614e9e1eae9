"""Rules of arithmetic that numbers of several types have."""

from typing import Any

from ...types import Equation
from .. import complex_arithmetic, extrema
from ..arithmetic import applied, compared, convert, power, total
from ..context import Context
from ..dtypes import ALL, BOOL, COMPLEX, FLOATS, INTEGERS, NUMBERS, REALS, is_signed, kind_of, part
from ..entrywise import entrywise
from ..values import Complex, Number, Value, parts


def _of_its_type(eqn: Equation) -> str | None:
    kept = eqn.params.get("out_dtype") in (None, eqn.invars[0].aval.dtype)
    return None if kept else f"`{eqn.primitive.name}` with a result of another type"


@entrywise("add sub mul div", NUMBERS, requires=_of_its_type)
def arithmetic(context: Context, a: Number, b: Number, **_: object) -> Any:
    """Arithmetic as JAX defines it: 0·x is not 0 where x is not finite."""
    return applied(context.code, context.name, context.dtype, a, b)


@entrywise("rem", REALS)
def rem(context: Context, a: Number, b: Number, **_: object) -> Any:
    """The remainder, with the sign of the first operand."""
    return applied(context.code, "rem", context.dtype, a, b)


@entrywise("max min", REALS | BOOL)
def extremum(context: Context, a: Number, b: Number, **_: object) -> Any:
    """The larger or the smaller; NaN where one is."""
    return applied(context.code, context.name, context.dtype, a, b)


@entrywise("add_any", ALL)
def add_any(context: Context, a: Number, b: Number, **_: object) -> Any:
    """The sum of two tangents."""
    return total(context.code, context.to, a, b)


@entrywise("eq ne", ALL)
def equality(context: Context, a: Number, b: Number, **_: object) -> Any:
    """Whether they are equal, or not; of complex numbers in both parts."""
    code, dtype = context.code, part(context.dtype)
    if context.dtype.kind != "c":
        return compared(code, context.name, dtype, a, b)
    both = [compared(code, context.name, dtype, x, y) for x, y in zip(parts(a), parts(b), strict=True)]
    return code.op("and" if context.name == "eq" else "or", "i1", *both)


@entrywise("lt le gt ge", REALS | BOOL)
def comparison(context: Context, a: Number, b: Number, **_: object) -> Any:
    """Whether they compare so."""
    return compared(context.code, context.name, context.dtype, a, b)


@entrywise("neg", NUMBERS)
def neg(context: Context, x: Number, **_: object) -> Any:
    """−x."""
    code, kind = context.code, kind_of(part(context.dtype))
    if context.dtype.kind == "c":
        return complex_arithmetic.negative(code, kind, x)
    return code.op("fneg", kind, x) if context.dtype.kind == "f" else code.op("sub", kind, 0, x)


@entrywise("abs", NUMBERS)
def absolute(context: Context, x: Number, **_: object) -> Any:
    """|x|."""
    code, dtype, kind = context.code, context.dtype, kind_of(part(context.dtype))
    if dtype.kind == "c":
        return complex_arithmetic.size(code, kind, x)
    if dtype.kind == "f":
        return extrema.absolute(code, kind, x)
    return code.intrinsic("smax", kind, x, code.op("sub", kind, 0, x)) if is_signed(dtype) else x


@entrywise("sign", REALS)
def sign(context: Context, x: Number, **_: object) -> Any:
    """−1, 0 or 1; a zero keeps its sign, and NaN is NaN."""
    code, dtype, kind = context.code, context.dtype, kind_of(context.dtype)
    if dtype.kind == "f":
        unit = code.intrinsic("copysign", kind, 1.0, x)
        return code.select(code.op("fcmp one", kind, x, 0.0, result="i1"), unit, x, kind)
    limited = applied(code, "min", dtype, x, 1)
    return applied(code, "max", dtype, limited, -1) if is_signed(dtype) else limited


@entrywise("square", NUMBERS)
def square(context: Context, x: Number, **_: object) -> Any:
    """x²."""
    return applied(context.code, "mul", context.dtype, x, x)


@entrywise("integer_pow", NUMBERS)
def integer_pow(context: Context, x: Number, *, y: int, **_: object) -> Any:
    """x to a whole power."""
    return x if y == 1 else power(context.code, x, y, context.dtype)


@entrywise("clamp", REALS)
def clamp(context: Context, low: Number, x: Number, high: Number, **_: object) -> Any:
    """`x`, moved into an interval."""
    raised = applied(context.code, "max", context.dtype, x, low)
    return applied(context.code, "min", context.dtype, raised, high)


@entrywise("convert_element_type", ALL, moves=True)
def convert_element_type(context: Context, x: Number, **_: object) -> Any:
    """The number as one of another type."""
    return convert(context.code, x, context.dtype, context.to)


@entrywise("real imag", COMPLEX)
def part_of(context: Context, x: Number, **_: object) -> Any:
    """The real or the imaginary part."""
    return getattr(x, context.name)


@entrywise("complex", FLOATS)
def from_parts(context: Context, a: Number, b: Number, **_: object) -> Any:
    """a + i b."""
    if isinstance(a, Value | Complex) or isinstance(b, Value | Complex):
        return Complex(a, b)
    return context.to.type(a + 1j * b)


@entrywise("conj", COMPLEX)
def conj(context: Context, x: Number, **_: object) -> Any:
    """The complex conjugate."""
    return complex_arithmetic.conjugate(context.code, kind_of(part(context.dtype)), x)


INTEGRAL = INTEGERS | BOOL


@entrywise("and or xor", INTEGRAL)
def bitwise(context: Context, a: Number, b: Number, **_: object) -> Any:
    """Bit by bit."""
    return applied(context.code, context.name, context.dtype, a, b)
