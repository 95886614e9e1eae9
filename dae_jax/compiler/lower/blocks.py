"""Loops over the indices of arrays, as instructions."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..thresholds import THRESHOLDS
from .instructions import Instructions
from .values import Index, Number, Run, Value


@contextlib.contextmanager
def loop(code: Instructions, count: Index, phis: list[str] | None = None) -> Iterator[Value]:
    """Runs what is written inside for an index from 0 to `count`; `phis` are other variables of the loop."""
    head, body, after, index, following = (code.name() for _ in range(5))
    before = code.block
    code.longest = max(code.longest, count if isinstance(count, int) else 0)
    code.jump(head)
    code.label(head)
    here = len(code.lines)
    i = Value(f"%{index}", "i64")
    code.branch(code.op("icmp slt", "i64", i, count, result="i1"), body, after)
    code.label(body)
    with code.scope():
        yield i
    code.lines.append(f"%{following} = add i64 %{index}, 1")
    own = f"%{index} = phi i64 [ 0, %{before} ], [ %{following}, %{code.block} ]"
    code.lines[here:here] = [own, *(phis or [])]
    code.jump(head, in_order=code.width > 1 or (isinstance(count, int) and count < THRESHOLDS.vectorised))
    code.label(after)


def for_each(
    code: Instructions, shape: Sequence[int], action: Callable[[list[Index]], None], few: int = THRESHOLDS.per_turn
) -> None:
    """Does something with each index, in loops whose body has the last `few` written out."""
    if 0 in shape:
        return
    outer, size = len(shape), 1
    while outer and size * shape[outer - 1] <= few:
        outer, size = outer - 1, size * shape[outer - 1]
    with contextlib.ExitStack() as stack:
        index = [0 if n == 1 else stack.enter_context(loop(code, n)) for n in shape[:outer]]
        for inner in np.ndindex(*shape[outer:]):
            action([*index, *inner])


def for_each_in_vectors(code: Instructions, shape: Sequence[int], action: Callable[[list[Index]], None]) -> None:
    """The same for several of the last index at once, as lanes, where that has as many entries as a vector; the last of them may be done
    twice.
    """
    *outer, count = shape
    width = next(w for w in THRESHOLDS.vectors if w <= count)

    def row(index: list[Index]) -> None:
        with contextlib.ExitStack() as stack:
            turns = -(-count // width)
            stack.enter_context(code.scope())
            base = 0 if turns == 1 else code.times(stack.enter_context(loop(code, turns)), width)
            if count % width and turns > 1:
                base = code.intrinsic("smin", "i64", base, count - width)
            code.longest = max(code.longest, count)
            code.width = width
            action([*index, Run(code, base)])
            code.width = 1

    for_each(code, outer, row, few=1)


def accumulated(
    code: Instructions,
    shape: Sequence[int],
    first: Sequence[Number],
    kinds: Sequence[str],
    step: Callable[[list[Number], list[Index]], Sequence[Number]],
) -> list[Any]:
    """What `step(found, index)` makes of the first numbers, index after index."""
    lanes = code.width > 1

    def over(index: list[Index], found: list[Number]) -> list[Any]:
        if len(index) == len(shape):
            return list(step(found, index))
        before, phis = code.block, []
        carried = [Value(f"%{code.name()}", kind, lanes) for kind in kinds]
        with loop(code, shape[len(index)], phis) as i:
            for x, y, z in zip(carried, found, over([*index, i], [*carried]), strict=True):
                start, after = (code.text(n, x.kind, lanes) for n in (y, z))
                vector = code.type(x.kind, lanes)
                phis.append(f"{x.name} = phi {vector} [ {start}, %{before} ], [ {after}, %{code.block} ]")
        return list(carried)

    if not lanes:
        return over([], list(first))
    return over([], [code.in_lanes(code.copy(x, kind)) for x, kind in zip(first, kinds, strict=True)])
