"""Rules of primitives on integers and truth values."""

from typing import Any

from ..context import Context
from ..dtypes import BOOL, BYTES, INTEGERS, kind_of
from ..entrywise import entrywise
from ..values import Number, Value


_SHIFTS = {"shift_left": "shl", "shift_right_logical": "lshr"}


@entrywise("not", INTEGERS | BOOL)
def inverted(context: Context, x: Number, **_: object) -> Value:
    """All bits the other way."""
    return context.code.op("xor", kind_of(context.dtype), x, -1)


@entrywise("shift_left shift_right_logical", INTEGERS)
def shift(context: Context, x: Number, by: Number, **_: object) -> Any:
    """By the width and more, and by less than none, all bits are shifted out; a shift of LLVM's is undefined there."""
    code, kind = context.code, kind_of(context.dtype)
    last = 8 * BYTES[kind] - 1
    shifted = code.op(_SHIFTS[context.name], kind, x, code.op("and", kind, by, last))
    return code.select(code.op("icmp ule", kind, by, last, result="i1"), shifted, 0, kind)


@entrywise("shift_right_arithmetic", INTEGERS)
def shift_right_arithmetic(context: Context, x: Number, by: Number, **_: object) -> Value:
    """The sign is shifted in, by the width and more everywhere."""
    code, kind = context.code, kind_of(context.dtype)
    return code.op("ashr", kind, x, code.intrinsic("umin", kind, by, 8 * BYTES[kind] - 1))


@entrywise("population_count", INTEGERS)
def bit_count(context: Context, x: Number, **_: object) -> Value:
    """How many bits are 1."""
    return context.code.intrinsic("ctpop", kind_of(context.dtype), x)


@entrywise("clz", INTEGERS)
def leading_zeros(context: Context, x: Number, **_: object) -> Value:
    """How many of the first bits are 0."""
    code, kind = context.code, kind_of(context.dtype)
    x = code.copy(x, kind)
    vector = code.type(kind, x.lanes)
    function = code.function(f"llvm.ctlz.{f'v{code.width}' if x.lanes else ''}{kind}", vector, vector, "i1")
    return code.pure(f"call {vector} {function}({vector} {x.name}, i1 false)", kind, x.lanes)
