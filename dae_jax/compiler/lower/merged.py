"""What branches give, brought together."""

from collections.abc import Sequence
from typing import Any

from ..thresholds import THRESHOLDS
from ..types import Aval
from .arrays import Buffer, Operand, View
from .dtypes import kinds_of
from .memory import Memory
from .operands import has_lanes, of_texts, texts
from .values import Value


def hold(xs: Sequence[Operand]) -> list[Buffer]:
    """Keeps the memory of arrays; gives what was not kept before."""
    found = [buffer for x in xs for buffer in getattr(x, "buffers", ()) if not buffer.held]
    for buffer in found:
        buffer.held = True
    return found


class Merged:
    """Entries as phi nodes, large arrays in the buffer that all branches share or in a new one."""

    def __init__(self, memory: Memory, aval: Aval) -> None:
        self.memory, self.aval = memory, aval
        large = aval.size > THRESHOLDS.carried
        self.kinds = [] if large else kinds_of(aval)
        self.view: View | None = memory.new(aval.dtype, aval.shape) if large else None

    def receive(self, values: Sequence[Operand], each: bool) -> None:
        """What each branch gives, when all have been written; `each`: lanes take branches of their own."""
        self.values = values
        self.lanes = each or any(map(has_lanes, values))
        self.texts = ["zeroinitializer" if self.lanes else "poison"] * len(self.kinds)
        first = values[0]
        same = lambda x: isinstance(x, View) and isinstance(first, View) and x.buffer is first.buffer and x.whole
        if self.view and isinstance(first, View) and all(map(same, values)):
            self.memory.recycle([self.view.buffer])
            self.view = first

    def deliver(self, k: int, taken: Value) -> None:
        """The end of a branch."""
        code, x = self.memory.code, self.values[k]
        self.before = self.texts
        if self.view is not None:
            if not (isinstance(x, View) and x.buffer is self.view.buffer):
                self.memory.assign(self.view, x)
            return
        self.texts = texts(code, self.aval, self.memory.entries(x), self.lanes)
        if taken.lanes:
            mask = f"{code.type('i1', True)} {taken.name}"
            self.texts = [
                code.write(f"select {mask}, {code.type(kind, True)} {y}, {code.type(kind, True)} {z}", kind, True).name
                for y, z, kind in zip(self.texts, self.before, self.kinds, strict=True)
            ]

    def join(self, end: str, skipped: str) -> None:
        """After a branch, taken or not."""
        code = self.memory.code
        self.texts = [
            code.write(f"phi {code.type(kind, self.lanes)} [ {x}, %{end} ], [ {y}, %{skipped} ]", kind, self.lanes).name
            for x, y, kind in zip(self.texts, self.before, self.kinds, strict=True)
        ]

    def value(self) -> Any:
        """What comes after all branches."""
        return of_texts(self.texts, self.aval, self.lanes) if self.view is None else self.view
