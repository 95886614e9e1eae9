"""Branches of jaxprs. With lanes a branch runs if any lane takes it, and a mask says which do."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..jaxprs.scalar_interpreter import is_number
from .arrays import SMALL, Buffer, View
from .instructions import Value
from .loops import Loops
from .operands import has_lanes, kinds_of, of_texts, texts
from .primitives import Primitives


class Branches(Loops):
    """Runs `cond`."""

    def _cond(self, eqn: Any, args: list[Any]) -> list[Any]:
        code, (which, *operands) = self.code, args
        branches = eqn.params["branches"]
        index = code.entries(which)[()]
        if is_number(index):
            return self.run(branches[min(max(int(index), 0), len(branches) - 1)], operands)
        dtype, mask, last = eqn.invars[0].aval.dtype, code.mask, len(branches) - 1
        taken = []
        for k in range(len(branches)):
            if np.dtype(dtype) == bool:
                here = index if k else code.op("xor", "i1", index, np.True_)
            else:
                here = code.compare("le" if k == 0 else "ge" if k == last else "eq", dtype, index, dtype.type(k))
            taken.append(code.op("and", "i1", mask, here) if mask is not None and here.lanes else here)
        kept = hold(operands)
        # The end of a branch comes before the next branch, though it is written after all: what it writes to is none of
        # the memory that a branch has used and let go.
        outs = [Merged(self, v.aval) for v in eqn.outvars]
        lines, before = code.lines, code.block
        found, written, starts, ends = [], [], [], []
        for branch, here in zip(branches, taken, strict=True):
            code.lines = []
            starts.append(code.name())
            code.label(starts[-1])
            code.mask = here if here.lanes else mask
            with code.scope():
                found.append(list(map(code.materialised, self.run(branch, operands))))
            written.append(code.lines)
            ends.append(code.block)
        code.lines, code.block, code.mask = lines, before, mask
        for out, values in zip(outs, zip(*found, strict=True), strict=True):
            out.receive(values, any(here.lanes for here in taken))
        for k, here in enumerate(taken):
            after, skipped = code.name(), code.block
            code.lines.append(f"br i1 {code.any(here).name}, label %{starts[k]}, label %{after}")
            code.lines += written[k]
            code.block, code.mask = ends[k], here if here.lanes else mask
            with code.scope():
                for out in outs:
                    out.deliver(k, here)
            end, code.mask = code.block, mask
            code.jump(after)
            code.label(after)
            for out in outs:
                out.join(end, skipped)
        for buffer in kept:
            buffer.held = False
        return [out.value() for out in outs]


def hold(xs: list[Any]) -> list[Buffer]:
    """Keeps the memory of arrays; gives what was not kept before."""
    found = [buffer for x in xs for buffer in getattr(x, "buffers", ()) if not buffer.held]
    for buffer in found:
        buffer.held = True
    return found


class Merged:
    """What branches give: entries as phi nodes, large arrays in the buffer that all share or in a new one."""

    def __init__(self, run: Primitives, aval: Any) -> None:
        self.run, self.aval = run, aval
        self.kinds = [] if aval.size > SMALL else kinds_of(aval)
        self.view: View | None = run.code.new(aval.dtype, aval.shape) if aval.size > SMALL else None

    def receive(self, values: Sequence[Any], each: bool) -> None:
        """What each branch gives, when all have been written; `each`: lanes take branches of their own."""
        self.values = values
        self.lanes = each or any(map(has_lanes, values))
        self.texts = ["zeroinitializer" if self.lanes else "poison"] * len(self.kinds)
        first = values[0]
        if self.view and all(isinstance(x, View) and x.buffer is first.buffer and x.whole for x in values):
            self.run.code.recycle([self.view.buffer])
            self.view = first

    def deliver(self, k: int, taken: Value) -> None:
        """The end of a branch."""
        code, x = self.run.code, self.values[k]
        self.before = self.texts
        if self.view is not None:
            if not (isinstance(x, View) and x.buffer is self.view.buffer):
                code.assign(self.view, x)
            return
        self.texts = texts(code, self.aval, code.entries(x), self.lanes)
        if taken.lanes:
            mask = f"{code.type('i1', True)} {taken.name}"
            self.texts = [
                code.write(f"select {mask}, {code.type(kind, True)} {y}, {code.type(kind, True)} {z}", kind, True).name
                for y, z, kind in zip(self.texts, self.before, self.kinds, strict=True)
            ]

    def join(self, end: str, skipped: str) -> None:
        """After a branch, taken or not."""
        code = self.run.code
        self.texts = [
            code.write(f"phi {code.type(kind, self.lanes)} [ {x}, %{end} ], [ {y}, %{skipped} ]", kind, self.lanes).name
            for x, y, kind in zip(self.texts, self.before, self.kinds, strict=True)
        ]

    def value(self) -> Any:
        return of_texts(self.texts, self.aval, self.lanes) if self.view is None else self.view
