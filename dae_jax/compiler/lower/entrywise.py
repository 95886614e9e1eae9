"""Operations that work out each entry from the entries at its place: written out in registers, or fused into loops."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..jaxprs.numbers import on_numbers
from ..jaxprs.objects import is_number, objects
from .arrays import Fused, Operand, View
from .context import Context
from .registry import always, rule


One = Callable[..., Any]


def entrywise(
    names: str,
    dtypes: frozenset[str] | Sequence[frozenset[str]],
    *,
    requires: Callable[[Any], str | None] = always,
    moves: bool = False,
) -> Callable[[One], One]:
    """Enters `one(context, *numbers, **params)`, which gives one entry, as the rule of some primitives."""

    def enter(one: One) -> One:
        def lower(context: Context, *args: Operand, **params: object) -> Any:
            of_entry = functools.partial(one, context, **params)
            return (
                _fused(context, of_entry, args)
                if context.large
                else _written_out(context, of_entry, list(map(context.entries, args)))
            )

        rule(names, dtypes, requires=requires, moves=moves, fuses=True)(lower)
        return one

    return enter


def _written_out(context: Context, one: One, args: Sequence[np.ndarray]) -> np.ndarray:
    shape = context.out.shape
    operands = [(a if a.shape == shape else np.broadcast_to(a, shape)).ravel() for a in args]
    if all(is_number(x) for operand in operands for x in operand):
        values = [np.array(list(operand), dtype) for operand, dtype in zip(operands, context.dtypes, strict=True)]
        numbers = on_numbers(context.eqn, values)
        if numbers is not None:
            return objects(list(numbers), shape)
    return objects([one(*x) for x in zip(*operands, strict=True)], shape)


def _fused(context: Context, one: One, args: Sequence[Operand]) -> Fused:
    memory = context.memory
    args = [_operand(context, k, a) for k, a in enumerate(args)]
    readers = [((lambda _, a=a: a[()]) if isinstance(a, np.ndarray) else memory.flat(a)) for a in args]
    flat = [read for read in readers if read]
    return Fused(
        context.to,
        tuple(context.out.shape),
        lambda index: one(*(memory.entry(a, index if a.ndim else []) for a in args)),
        tuple(b for a in args if not isinstance(a, np.ndarray) for b in a.buffers),
        (lambda place: one(*(read(place) for read in flat))) if len(flat) == len(args) else None,
        1 + max((getattr(a, "depth", 0) for a in args), default=0),
    )


def _operand(context: Context, k: int, x: Operand) -> np.ndarray | View | Fused:
    """An operand of the result's shape, or with axes of length 1 whose one entry is read at any index."""
    shape = tuple(context.out.shape)
    if x.size == 1:
        return context.memory.entries(x).reshape(())
    if isinstance(x, Fused) and x.shape == shape:
        return x
    x = context.view(x, k)
    strides = tuple(0 if n == 1 else s for n, s in zip(x.shape, x.strides, strict=True))
    return x if x.contiguous and x.shape == shape else dataclasses.replace(x, strides=strides)
