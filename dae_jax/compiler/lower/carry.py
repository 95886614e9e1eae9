"""What a loop hands from one turn to the next."""

from collections.abc import Sequence
from typing import Any

from ..thresholds import THRESHOLDS
from ..types import Aval
from .arrays import Operand, View
from .dtypes import kinds_of
from .instructions import Instructions
from .memory import Memory
from .operands import of_texts, retain, texts
from .values import Value


class Carry:
    """Entries as phi nodes, large arrays in a buffer of the loop's own; `lanes`: which differ from lane to lane."""

    def __init__(self, memory: Memory, avals: list[Aval], first: list[Operand], lanes: Sequence[bool]) -> None:
        self.memory, self.avals = memory, avals
        self.lanes = list(lanes) or [False] * len(avals)
        self.values: list[Any] = []
        self.names: list[list[str]] = []
        self.first: list[list[str]] = []
        for aval, x, each in zip(avals, first, self.lanes, strict=True):
            self._enter(aval, x, each)
        for x in self.values:
            retain(x, -1)

    def _enter(self, aval: Aval, x: Operand, each: bool) -> None:
        code = self.memory.code
        if aval.size > THRESHOLDS.carried:
            x = self.memory.own(x, aval.dtype)
            retain(x, 1)
            x.buffer.held = True
            self.names.append([])
            self.first.append([])
        else:
            self.first.append(texts(code, aval, self.memory.entries(x), each))
            self.names.append([f"%{code.name()}" for _ in kinds_of(aval)])
            x = of_texts(self.names[-1], aval, each)
        self.values.append(x)

    def turn(self, new: list[Operand], entered: str, mask: Value | None) -> list[str]:
        """The end of a turn; gives the phi nodes at its beginning."""
        code, phis, following = self.memory.code, [], []
        new = kept_apart(self.memory, new, self.values, self.avals)
        for aval, x, own, names, each in zip(self.avals, new, self.values, self.names, self.lanes, strict=True):
            following.append([])
            if not isinstance(own, View):
                found = texts(code, aval, self.memory.entries(x), each)
                following[-1] = found if mask is None else _chosen(code, mask, found, names, kinds_of(aval))
            elif not (isinstance(x, View) and x.buffer is own.buffer):
                self.memory.assign(own, x)
        for aval, names, before, after, each in zip(
            self.avals, self.names, self.first, following, self.lanes, strict=True
        ):
            kinds = kinds_of(aval) if names else []
            for name, x, y, kind in zip(names, before, after, kinds, strict=True):
                phis.append(f"{name} = phi {code.type(kind, each)} [ {x}, %{entered} ], [ {y}, %{code.block} ]")
        return phis


def _chosen(code: Instructions, mask: Value, new: list[str], old: list[str], kinds: list[str]) -> list[str]:
    """What is new in the lanes of a mask."""
    condition = f"select {code.type('i1', True)} {mask.name}"
    return [
        y if y == z else code.write(f"{condition}, {code.type(k, True)} {y}, {code.type(k, True)} {z}", k, True).name
        for y, z, k in zip(new, old, kinds, strict=True)
    ]


def kept_apart(memory: Memory, new: list[Operand], carry: list[Operand], avals: list[Aval]) -> list[Any]:
    """What a turn gives: few entries as they are now, large arrays copied where they lie in a buffer of the loop's that gets
    something else.
    """
    new = list(map(memory.materialised, new))
    held = {x.buffer for x in carry if isinstance(x, View)}

    def overwritten(x: Operand, own: View) -> bool:
        return isinstance(x, View) and x.buffer in held and not (x.buffer is own.buffer and x.whole)

    def kept(x: Operand, own: Operand, aval: Aval) -> Any:
        if not isinstance(own, View):
            return memory.entries(x)
        return memory.copied(x, aval.dtype) if overwritten(x, own) else x

    return [kept(*each) for each in zip(new, carry, avals, strict=True)]
