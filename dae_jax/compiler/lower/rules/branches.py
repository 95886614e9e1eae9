"""The rule of branches. With lanes a branch runs if any lane takes it, and a mask says which do."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from ...jaxprs.objects import is_number
from ..arithmetic import compared
from ..arrays import Operand
from ..context import Context
from ..dtypes import ALL, BOOL, INTEGERS
from ..merged import Merged, hold
from ..registry import free, rule
from ..values import Value


@dataclasses.dataclass(frozen=True)
class _Branch:
    """A branch that has been written: who takes it, its instructions, its first and its last block, what it gives."""

    taken: Value
    lines: list[str]
    start: str
    end: str
    values: list[Any]


@rule("cond", (INTEGERS | BOOL, ALL), cost=free, nested=True)
def cond(context: Context, *args: Operand, branches: Sequence[ClosedJaxpr], **_: object) -> list[Any]:
    """The branch of a number, known or found at run time."""
    code, memory = context.code, context.memory
    which, *operands = map(memory.materialised, args)
    index = memory.number(which)
    if is_number(index):
        return context.run(branches[min(max(int(index), 0), len(branches) - 1)], operands)
    taken = [_taken(context, index, k, len(branches) - 1) for k in range(len(branches))]
    kept = hold(operands)
    # The end of a branch comes before the next branch, though it is written after all: what it writes to is none of
    # the memory that a branch has used and let go.
    outs = [Merged(memory, aval) for aval in context.outs]
    lines, before, mask = code.lines, code.block, code.mask
    written = [_written(context, branch, operands, here) for branch, here in zip(branches, taken, strict=True)]
    code.lines, code.block = lines, before
    for out, values in zip(outs, zip(*(branch.values for branch in written), strict=True), strict=True):
        out.receive(values, any(here.lanes for here in taken))
    for k, branch in enumerate(written):
        _joined(context, k, branch, outs)
    code.mask = mask
    for buffer in kept:
        buffer.held = False
    return [out.value() for out in outs]


def _taken(context: Context, index: Value, k: int, last: int) -> Value:
    """Which lanes take a branch."""
    code, dtype = context.code, context.dtypes[0]
    if dtype.kind == "b":
        here = index if k else code.op("xor", "i1", index, np.True_)
    else:
        here = compared(code, "le" if k == 0 else "ge" if k == last else "eq", dtype, index, dtype.type(k))
    return code.op("and", "i1", code.mask, here) if code.mask is not None and here.lanes else here


def _written(context: Context, branch: ClosedJaxpr, operands: list[Operand], taken: Value) -> _Branch:
    code, mask = context.code, context.code.mask
    code.lines, start = [], code.name()
    code.label(start)
    code.mask = taken if taken.lanes else mask
    with code.scope():
        values = list(map(context.memory.materialised, context.run(branch, operands)))
    code.mask = mask
    return _Branch(taken, code.lines, start, code.block, values)


def _joined(context: Context, k: int, branch: _Branch, outs: list[Merged]) -> None:
    """A branch comes here, if any lane takes it."""
    code, mask = context.code, context.code.mask
    after, skipped = code.name(), code.block
    code.branch(code.any(branch.taken), branch.start, after)
    code.lines += branch.lines
    code.block, code.mask = branch.end, branch.taken if branch.taken.lanes else mask
    with code.scope():
        for out in outs:
            out.deliver(k, branch.taken)
    end, code.mask = code.block, mask
    code.jump(after)
    code.label(after)
    for out in outs:
        out.join(end, skipped)
