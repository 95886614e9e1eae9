"""Rules of sums, products and extrema along axes."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...jaxprs.objects import columns, objects
from ...thresholds import THRESHOLDS
from ...types import Equation
from .. import complex_arithmetic
from ..access import load, store
from ..arithmetic import applied, better, combined, convert, identity
from ..arrays import Fused, Operand, View
from ..blocks import accumulated, for_each
from ..context import Context
from ..dtypes import BOOL, FLOATS, INTEGERS, NUMBERS, REALS, kind_of, parts_of
from ..registry import rule
from ..values import Complex, Index, Number, parts


_FOLDS = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
    "reduce_or": "or", "reduce_xor": "xor", "cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min",
    "cumlogsumexp": "logaddexp",
}  # fmt: skip


def operand_size(eqn: Equation) -> int:
    """An instruction for each entry of the operand."""
    return eqn.invars[0].aval.size


def in_pairs(combine: Callable[[Number, Number], Number], terms: list[Number]) -> Any:
    """All terms combined, two by two: none waits for the sum of all before it, and less is rounded off."""
    while len(terms) > 1:
        rest = terms[len(terms) // 2 * 2 :]
        terms = [combine(a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)] + rest
    return terms[0]


@rule("reduce_sum reduce_prod", NUMBERS | BOOL, cost=operand_size)
def total(context: Context, x: Operand, *, axes: Sequence[int], **_: object) -> Any:
    """The sum or the product along axes."""
    return _in_memory(context, x, axes) if context.large else _in_registers(context, context.entries(x), axes)


@rule("reduce_max reduce_min", REALS | BOOL, cost=operand_size)
def extremum(context: Context, x: Operand, *, axes: Sequence[int], **_: object) -> Any:
    """The largest or the smallest along axes."""
    return _in_memory(context, x, axes) if context.large else _in_registers(context, context.entries(x), axes)


@rule("reduce_and reduce_or reduce_xor", INTEGERS | BOOL, cost=operand_size)
def bitwise(context: Context, x: Operand, *, axes: Sequence[int], **_: object) -> Any:
    """Bit by bit along axes."""
    return _in_memory(context, x, axes) if context.large else _in_registers(context, context.entries(x), axes)


def _combine(context: Context) -> Callable[[Any, Any], Any]:
    return functools.partial(combined, context.code, _FOLDS[context.name], context.to)


def _in_registers(context: Context, x: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    x, combine = columns(x, tuple(axes)), _combine(context)
    first = [] if x.shape[0] else [identity(_FOLDS[context.name], context.to)]
    return objects([in_pairs(combine, [*x[(slice(None), *i)], *first]) for i in np.ndindex(x.shape[1:])], x.shape[1:])


def _in_memory(context: Context, x: Operand, axes: Sequence[int]) -> Any:
    memory, out, name, dtype = context.memory, context.out, _FOLDS[context.name], context.to
    x = context.array(x) if x.ndim else x
    buffers = () if isinstance(x, np.ndarray) else x.buffers
    kept = [d for d in range(x.ndim) if d not in axes]
    extents = [x.shape[d] for d in axes]
    first, flat = identity(name, dtype), memory.flat(x)

    def entry(at: Sequence[Index], of: Sequence[Index]) -> Any:
        index: list[Any] = [None] * x.ndim
        for d, i in (*zip(kept, at, strict=True), *zip(axes, of, strict=True)):
            index[d] = i
        return memory.entry(x, index)

    if math.prod(extents) <= THRESHOLDS.carried:
        read = lambda at: in_pairs(_combine(context), [entry(at, of) for of in np.ndindex(*extents)] or [first])
        return Fused(dtype, tuple(out.shape), read, buffers, depth=getattr(x, "depth", 0) + 1)
    if not kept and flat:
        return objects([folded(context, name, [x.size], first, lambda i: flat(i[0]))], ())
    if not kept or max(kept) < max(axes):
        read = lambda at: folded(context, name, extents, first, functools.partial(entry, at))
        return objects([read([])], ()) if not kept else memory.made(dtype, out.shape, read)
    return _row_by_row(context, memory.view(x, dtype), kept, first)


def _row_by_row(context: Context, x: View, kept: list[int], first: Number) -> View:
    """What lies together is read together: all results at once, from row after row."""
    code, memory = context.code, context.memory
    result = memory.made(context.to, context.out.shape, lambda _: first)

    def add(index: list[Index]) -> None:
        place = memory.at(result, [index[d] for d in kept])
        found = _combine(context)(load(code, result.buffer, place), memory.entry(x, index))
        store(code, result.buffer, place, found)

    with code.unmasked():
        for_each(code, x.shape, add)
    return result


def folded(
    context: Context, name: str, shape: Sequence[int], first: Number, entry: Callable[[list[Index]], Number]
) -> Any:
    """Entries combined by a loop, in any order."""
    code, dtype = context.code, context.to
    kind, count = parts_of(dtype)

    def step(found: list[Number], index: list[Index]) -> Sequence[Any]:
        if name == "add" and dtype.kind in "fc":
            terms = parts(entry(index)) if count == 2 else (entry(index),)
            return [code.op("fadd reassoc contract", kind, a, b) for a, b in zip(found, terms, strict=True)]
        if count == 2:
            return parts(complex_arithmetic.OPERATIONS[name](code, kind, Complex(*found), entry(index)))
        return [applied(code, name, dtype, found[0], entry(index))]

    out = accumulated(code, shape, parts(first)[:count], [kind] * count, step)
    return Complex(*out) if count == 2 else out[0]


@rule("cumsum cumprod", NUMBERS, cost=operand_size)
def running_total(context: Context, x: Operand, *, axis: int, reverse: bool) -> Any:
    """The sum or the product of all entries up to here."""
    return (
        _running_in_memory(context, x, axis, reverse)
        if context.large
        else _running(context, context.entries(x), axis, reverse)
    )


@rule("cumlogsumexp", FLOATS, cost=operand_size)
def running_log_of_sum(context: Context, x: Operand, *, axis: int, reverse: bool) -> Any:
    """The logarithm of the sum of the exponentials of all entries up to here."""
    return (
        _running_in_memory(context, x, axis, reverse)
        if context.large
        else _running(context, context.entries(x), axis, reverse)
    )


@rule("cummax cummin", REALS | BOOL, cost=operand_size)
def running_extremum(context: Context, x: Operand, *, axis: int, reverse: bool) -> Any:
    """The largest or the smallest of all entries up to here."""
    return (
        _running_in_memory(context, x, axis, reverse)
        if context.large
        else _running(context, context.entries(x), axis, reverse)
    )


def _running(context: Context, x: np.ndarray, axis: int, reverse: bool) -> np.ndarray:
    combine, out = _combine(context), np.moveaxis(x.copy(), axis, 0)
    out = out[::-1] if reverse else out
    if _begins_at_zero(context, len(out)):
        for j in np.ndindex(out.shape[1:]):
            out[(0, *j)] = combine(_zero(context), out[(0, *j)])
    for i in range(1, len(out)):
        for j in np.ndindex(out.shape[1:]):
            out[(i, *j)] = combine(out[(i - 1, *j)], out[(i, *j)])
    return np.moveaxis(out[::-1] if reverse else out, 0, axis)


def _running_in_memory(context: Context, x: Operand, axis: int, reverse: bool) -> View:
    """In place, from the second entry on."""
    code, memory = context.code, context.memory
    out = memory.copied(context.array(x), context.to)
    turns = [n - (d == axis) for d, n in enumerate(out.shape)]

    def add(index: list[Index]) -> None:
        i = index[axis]
        i = code.plus(out.shape[axis] - 2, code.times(i, -1)) if reverse else code.plus(i, 1)
        here, before = ([*index[:axis], k, *index[axis + 1 :]] for k in (i, code.plus(i, 1 if reverse else -1)))
        found = _combine(context)(memory.entry(out, before), memory.entry(out, here))
        store(code, out.buffer, memory.at(out, here), found)

    def begin(index: list[Index]) -> None:
        here = [*index[:axis], out.shape[axis] - 1 if reverse else 0, *index[axis + 1 :]]
        store(code, out.buffer, memory.at(out, here), _combine(context)(_zero(context), memory.entry(out, here)))

    with code.unmasked():
        if _begins_at_zero(context, out.shape[axis]):
            for_each(code, [1 if d == axis else n for d, n in enumerate(out.shape)], begin)
        for_each(code, turns, add)
    return out


def _begins_at_zero(context: Context, entries: int) -> bool:
    """Whether −0 is counted as 0, as XLA does in sums of several numbers."""
    return context.name == "cumsum" and context.to.kind in "fc" and entries > 1


def _zero(context: Context) -> Any:
    return Complex(0.0, 0.0) if context.to.kind == "c" else context.to.type(0)


@rule("argmax argmin", REALS | BOOL, cost=operand_size)
def place_of_extremum(context: Context, x: Operand, *, axes: Sequence[int], **_: object) -> Any:
    """Where the first of the largest or the smallest is along an axis."""
    return (
        _place_in_memory(context, x, *axes)
        if context.large
        else _place_in_registers(context, context.entries(x), *axes)
    )


def _place_in_registers(context: Context, x: np.ndarray, axis: int) -> np.ndarray:
    choose = functools.partial(better, context.code, context.name, context.dtype, context.to)
    moved = np.moveaxis(x, axis, 0)
    found = [
        functools.reduce(choose, [(moved[(i, *j)], context.to.type(i)) for i in range(len(moved))])
        for j in np.ndindex(moved.shape[1:])
    ]
    return objects([place for _, place in found], moved.shape[1:])


def _place_in_memory(context: Context, x: Operand, axis: int) -> View | Fused:
    code, memory, to = context.code, context.memory, context.to
    x = context.array(x)
    choose = functools.partial(better, code, context.name, context.dtype, to)

    def read(at: Sequence[Index]) -> Any:
        entry = lambda i: memory.entry(x, [*at[:axis], i, *at[axis:]])

        def step(found: list[Number], index: list[Index]) -> Sequence[Any]:
            place = convert(code, index[0], np.dtype("int64"), to)
            return choose(found, (entry(index[0]), place))

        kinds = [kind_of(x.dtype), kind_of(to)]
        return accumulated(code, [x.shape[axis]], (entry(0), to.type(0)), kinds, step)[1]

    out = context.out
    return memory.made(to, out.shape, read) if out.size > memory.few else Fused(to, tuple(out.shape), read, x.buffers)
