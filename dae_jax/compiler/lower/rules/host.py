"""The rule of functions on the host."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..._compat import callback_function
from ...emit.host_functions import HOST, place
from ...types import Equation
from ..arrays import Operand, View
from ..context import Context
from ..dtypes import ALL
from ..registry import rule


def _may_raise(eqn: Equation) -> str | None:
    """Machine code cannot raise what a function does that does not say `never_raises`."""
    if getattr(callback_function(eqn), "never_raises", False):
        return None
    return "`pure_callback` of a function that may raise"


def addresses(eqn: Equation) -> int:
    """What is handed over."""
    return 2 * (len(eqn.invars) + len(eqn.outvars))


@rule("pure_callback", ALL, requires=_may_raise, cost=addresses, by_memory=True, on_host=True)
def pure_callback(context: Context, *args: Operand, callback: Any, **_: object) -> list[Any]:
    """What a function of the user's gives."""
    return on_host(context, callback, args)


def on_host(context: Context, fn: Callable[..., Any], args: Sequence[Operand]) -> list[Any]:
    """What a function on the host gives, in the lanes that take part."""
    code, memory = context.code, context.memory
    ins = [_own_memory(context, x, k) for k, x in enumerate(args)]
    outs = [memory.new(np.dtype(v.dtype), v.shape) for v in context.outs]
    addresses = f"%{code.name()}"
    memory.stack.append(f"{addresses} = alloca [{len(ins) + len(outs)} x ptr], align 64")
    for k, x in enumerate((*ins, *outs)):
        at = f"%{code.name()}"
        code.lines += [
            f"{at} = getelementptr ptr, ptr {addresses}, i64 {k}",
            f"store ptr {x.buffer.pointer}, ptr {at}",
        ]
    function = code.function(HOST, "void", "i64", "i64", "ptr")
    number = place(fn, [v.aval for v in context.eqn.invars], context.outs, code.width)
    code.lines.append(f"call void {function}(i64 {number}, i64 {_lanes(context)}, ptr {addresses})")
    return outs


def _own_memory(context: Context, x: Operand, k: int) -> View:
    """Operand k in memory of this function, whole, with as many lanes as it has."""
    lanes = context.code.width > 1
    if isinstance(x, View) and x.whole and x.buffer.bytes and x.buffer.lanes == lanes:
        return x
    return context.memory.copied(x, context.dtypes[k])


def _lanes(context: Context) -> str:
    """The lanes that take part, as bits of an integer."""
    code = context.code
    if code.mask is None or not code.mask.lanes:
        return str(2**code.width - 1)
    bits = code.write(f"bitcast {code.operand(code.mask, 'i1', True)} to i{code.width}", f"i{code.width}", False)
    return code.write(f"zext i{code.width} {bits.name} to i64", "i64", False).name
