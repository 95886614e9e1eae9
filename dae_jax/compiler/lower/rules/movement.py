"""Rules of what moves the entries of arrays: other names in registers; in memory views, or what is read elsewhere."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...jaxprs.movement import MOVEMENTS
from ..arithmetic import convert
from ..arrays import Fused, Operand, View, row_major
from ..context import Context
from ..dtypes import ALL, REALS
from ..registry import free, rule
from ..values import Index


def movement(
    names: str, dtypes: frozenset[str] = ALL, fuses: bool = False
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Enters a function as the rule of what moves entries in memory; in registers the same entries are at other indices."""

    def enter(in_memory: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(in_memory)
        def lower(context: Context, *args: Operand, **params: object) -> Any:
            move = functools.partial(in_memory, **params) if context.large else _in_registers
            return move(context, *args)

        return rule(names, dtypes, cost=free, moves=True, fuses=fuses)(lower)

    return enter


def _in_registers(context: Context, *args: Operand) -> Any:
    return MOVEMENTS[context.name](context.eqn, *map(context.entries, args))


@movement("reshape squeeze expand_dims")
def reshape(context: Context, x: Operand, **_: object) -> Any:
    """The same entries in order, with other indices."""
    x, shape = context.array(x), tuple(context.out.shape)
    found = _in_order(context, x, shape)
    if found is not None:
        return found
    x = _viewed(context, x)
    x = x if x.contiguous else context.memory.copied(x, x.dtype)
    return View(x.dtype, shape, x.buffer, row_major(shape), x.offset)


@movement("broadcast_in_dim")
def broadcast_in_dim(
    context: Context, x: Operand, *, shape: Sequence[int], broadcast_dimensions: Sequence[int], **_: object
) -> Any:
    """Entries at several indices."""
    x, shape = context.array(x), tuple(shape)
    if list(broadcast_dimensions) == sorted(broadcast_dimensions) and x.size == math.prod(shape):
        found = _in_order(context, x, shape)
        if found is not None:
            return found
    x = _viewed(context, x)
    of = {d: (0 if n == 1 else s) for d, n, s in zip(broadcast_dimensions, x.shape, x.strides, strict=True)}
    return View(x.dtype, shape, x.buffer, tuple(of.get(d, 0) for d in range(len(shape))), x.offset)


@movement("transpose")
def transpose(context: Context, x: Operand, *, permutation: Sequence[int]) -> Any:
    """Axes in another order."""
    x, shape = context.array(x), tuple(context.out.shape)
    if isinstance(x, Fused):
        order = np.argsort(permutation)
        return x.moved(shape, lambda index: x.read([index[d] for d in order]))
    return View(x.dtype, shape, x.buffer, tuple(x.strides[d] for d in permutation), x.offset)


@movement("rev")
def rev(context: Context, x: Operand, *, dimensions: Sequence[int]) -> Any:
    """Axes from their end."""
    x = _viewed(context, context.array(x))
    offset = x.offset
    for d in dimensions:
        offset = context.code.plus(offset, x.strides[d] * (x.shape[d] - 1))
    strides = tuple(-s if d in dimensions else s for d, s in enumerate(x.strides))
    return View(x.dtype, x.shape, x.buffer, strides, offset)


@movement("slice")
def slice_(context: Context, x: Operand, *, start_indices: Sequence[int], strides: Sequence[int], **_: object) -> Any:
    """A part of the array."""
    code, x, shape = context.code, context.array(x), tuple(context.out.shape)
    starts, steps = list(map(int, start_indices)), list(map(int, strides or (1,) * x.ndim))
    if isinstance(x, Fused):
        read = lambda index: x.read(
            [code.plus(s, code.times(i, k)) for s, i, k in zip(starts, index, steps, strict=True)]
        )
        return x.moved(shape, read)
    offset = code.plus(x.offset, sum(map(int.__mul__, starts, x.strides)))
    return View(x.dtype, shape, x.buffer, tuple(map(int.__mul__, steps, x.strides)), offset)


@movement("tile")
def tile(context: Context, x: Operand, **_: object) -> Any:
    """The array repeated along its axes."""
    x = _viewed(context, context.array(x))
    read = lambda index: context.memory.entry(x, [_modulo(context, i, n) for i, n in zip(index, x.shape, strict=True)])
    return Fused(x.dtype, tuple(context.out.shape), read, x.buffers)


def _modulo(context: Context, i: Index, n: int) -> Any:
    return i % n if isinstance(i, int) else context.code.op("urem", "i64", i, n)


@movement("split unstack")
def split(context: Context, x: Operand, *, axis: int, **_: object) -> Any:
    """Pieces of an array along an axis, or its entries there."""
    x, start, out = context.array(x), 0, []
    entries = context.name == "unstack"
    for aval in context.outs:
        after = [start * (d == axis) for d in range(x.ndim)]
        if isinstance(x, View):
            strides = tuple(s for d, s in enumerate(x.strides) if d != axis or not entries)
            out.append(View(x.dtype, aval.shape, x.buffer, strides, context.memory.at(x, after)))
        else:
            whole = (lambda index: [*index[:axis], 0, *index[axis:]]) if entries else list
            read = lambda index, after=after, whole=whole: x.read(list(map(context.code.plus, whole(index), after)))
            out.append(x.moved(aval.shape, read))
        start += 1 if entries else aval.shape[axis]
    return out


@movement("concatenate")
def concatenate(context: Context, *args: Operand, dimension: int) -> Any:
    """Arrays one after another along an axis."""
    return _joined(context, args, dimension, False)


@movement("stack")
def stack(context: Context, *args: Operand, axis: int, **_: object) -> Any:
    """Arrays one after another along a new axis."""
    return _joined(context, args, axis, True)


def _joined(context: Context, args: Sequence[Operand], axis: int, along_new: bool) -> View:
    memory = context.memory
    args = [context.array(x, k) if x.ndim else x for k, x in enumerate(args)]
    result, start = memory.new(context.to, context.out.shape), 0
    strides = tuple(s for d, s in enumerate(result.strides) if d != axis or not along_new)
    for x in args:
        part = View(result.dtype, x.shape, result.buffer, strides, start * result.strides[axis])
        memory.assign(part, x, fresh=True)
        start += 1 if along_new else x.shape[axis]
    return result


@movement("pad")
def pad(context: Context, x: Operand, fill: Operand, *, padding_config: Sequence[tuple[int, int, int]]) -> Any:
    """Something else around the entries and between them; of a negative width that many entries are left out."""
    memory, x = context.memory, context.array(x) if x.ndim else x
    config = [tuple(map(int, c)) for c in padding_config]
    value = memory.entry(fill, [])
    around = [(max(low, 0), max(high, 0)) for low, high, _ in config]
    within = [n + max(n - 1, 0) * gap for n, (_, _, gap) in zip(x.shape, config, strict=True)]
    shape = [low + n + high for n, (low, high) in zip(within, around, strict=True)]
    result = memory.made(context.to, shape, lambda _: value)
    offset = sum(low * s for (low, _), s in zip(around, result.strides, strict=True))
    strides = tuple((gap + 1) * s for (_, _, gap), s in zip(config, result.strides, strict=True))
    memory.assign(View(result.dtype, x.shape, result.buffer, strides, offset), x, fresh=True)
    if all(low >= 0 and high >= 0 for low, high, _ in config):
        return result
    left_out = sum(max(-low, 0) * s for (low, _, _), s in zip(config, result.strides, strict=True))
    return View(result.dtype, tuple(context.out.shape), result.buffer, result.strides, left_out)


@movement("iota", REALS, fuses=True)
def iota(context: Context, *, dimension: int, **_: object) -> Any:
    """Indices along an axis."""
    code, to, of = context.code, context.to, np.dtype("int64")
    number = lambda i: convert(code, np.int64(i) if isinstance(i, int) else i, of, to)
    return Fused(to, tuple(context.out.shape), lambda index: number(index[dimension]), ())


def _in_order(context: Context, x: View | Fused, shape: tuple[int, ...]) -> Fused | None:
    """What is yet to be computed read in another shape, where its entries can be read by their place."""
    flat = context.memory.flat(x) if isinstance(x, Fused) else None
    if not isinstance(x, Fused) or not flat or not shape:
        return None
    code = context.code
    place = lambda index: functools.reduce(code.plus, map(code.times, index, row_major(shape)))
    return x.moved(shape, lambda index: flat(place(index)), flat)


def _viewed(context: Context, x: View | Fused) -> View:
    return context.memory.copied(x, x.dtype) if isinstance(x, Fused) else x
