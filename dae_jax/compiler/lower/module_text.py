"""A jaxpr as one function in the machine's code: for one element, for a batch whose elements are lanes of vectors, or for one
with a thread for each element.
"""

import contextlib
from typing import Any

import numpy as np

from ..emit import ptx
from ..emit.interface import batch_size, buffer
from ..emit.runtime import alone, heap, in_threads, in_turn
from ..thresholds import THRESHOLDS
from ..types import Aval
from .access import store
from .annotated import Annotated
from .arrays import Buffer, Operand, View, row_major
from .dtypes import parts_of
from .lane_queue import LaneQueue, NotQueued, main_loop
from .lowering import Lowering, TooLarge
from .values import Value


# Of the loops that LLVM shall not make ones of vectors.
IN_ORDER = '!0 = distinct !{!0, !1}\n!1 = !{!"llvm.loop.vectorize.enable", i1 false}'


def module_text(annotated: Annotated, always_copies: bool = False, limit: float = np.inf) -> str:
    """The module whose function `{name}.kernel` computes the outputs from the inputs.

    With batched inputs the function is that of a batch: these inputs, and all outputs, have a leading axis of any length.
    `always_copies`: nothing is updated in place, and no memory used twice.

    Errors: `TooLarge` for more than `limit` instructions, or arrays that take too much memory; none without a limit.
    """
    lanes = any(annotated.batched) and not annotated.target.threads
    place = main_loop(annotated.jaxpr) if lanes else None
    if place is not None:
        with contextlib.suppress(NotQueued):
            return _Module(annotated, always_copies, limit).text(place)
    return _Module(annotated, always_copies, limit).text(None)


class _Module:
    def __init__(self, annotated: Annotated, always_copies: bool, limit: float) -> None:
        self.jaxpr, self.limit, self.target = annotated.jaxpr, limit, annotated.target
        self.batched = list(annotated.batched) or [False] * len(self.jaxpr.jaxpr.invars)
        self.lowering = Lowering(annotated.width, always_copies, limit, annotated.inlined, target=self.target)
        self.code, self.memory = self.lowering.code, self.lowering.memory

    def text(self, place: int | None) -> str:
        """The module's text; `place`: where the main loop is, if lanes shall be refilled."""
        code, memory, lanes = self.code, self.memory, any(self.batched)
        ins, outs = self.jaxpr.jaxpr.invars, self.jaxpr.jaxpr.outvars
        code.block = "start"
        if lanes and self.target.threads:
            self._elements()
        elif lanes:
            self._batch(place)
        else:
            self._store(self.lowering.run(self.jaxpr, self._arguments(None)), None, None)
        constants = [f"{name} = {text}" for text, name in memory.constants.items()]
        found = [line for k in range(len(ins)) for line in buffer("%args", k, f"arg{k}")]
        found += [line for k in range(len(outs)) for line in buffer("%results", k, f"result{k}")]
        taken, given_back = self._heap()
        # What is on the stack belongs into the first block: elsewhere LLVM keeps none of it in registers.
        body = [*memory.stack, *taken, *memory.in_room, "br label %start", "start:", *code.lines, *given_back]
        if self.target.is_gpu:
            functions = ptx.kernel(body, len(ins), len(outs), memory.room)
        elif lanes and self.target.threads:
            code.function("malloc", "ptr", "i64")
            code.function("free", "void", "ptr")
            functions = in_turn([*found, *batch_size(f"arg{self.batched.index(True)}"), *body], memory.room)
        elif lanes:
            functions = in_threads([*found, *body], self._find_batch(), code.width)
        else:
            functions = alone([*found, *body], code.longest >= THRESHOLDS.long_loop)
        return "\n".join([*constants, *code.declared.values(), *self.lowering.procedures.lines, *functions, IN_ORDER])

    def _find_batch(self) -> list[str]:
        """The instructions that find the size of the batch."""
        first = self.batched.index(True)
        return [*buffer("%args", first, f"arg{first}"), *batch_size(f"arg{first}")]

    def _heap(self) -> tuple[list[str], list[str]]:
        """The instructions that take the memory of all arrays that are not on the stack, and that give it back."""
        code, size = self.code, self.memory.heap
        if size > THRESHOLDS.heap_bytes and self.limit < np.inf:
            raise TooLarge
        if not size:
            return [], []
        if self.target.threads:
            return [f"%heap = alloca [{size} x i8], align 64", *self.memory.on_heap], []
        code.function("malloc", "ptr", "i64")
        code.function("free", "void", "ptr")
        taken, given_back = heap(size)
        return [*taken, *self.memory.on_heap], given_back

    def _arguments(self, row: Value | None) -> list[Any]:
        """The arguments, of the element that each lane has."""
        args = []
        for k, (v, batched) in enumerate(zip(self.jaxpr.jaxpr.invars, self.batched, strict=True)):
            if not batched:
                args.append(self.lowering.argument(k, v.aval))
                continue
            x = self._view(f"%arg{k}", v.aval, row, writable=False)
            args.append(x if x.size > THRESHOLDS.carried else self.memory.entries(x))
        return args

    def _store(self, results: list[Operand], row: Value | None, mask: Value | None) -> None:
        """Stores the results of the element that each lane has, in the lanes of the mask."""
        code, memory = self.code, self.memory
        before, code.mask = code.mask, mask
        for k, (v, x) in enumerate(zip(self.jaxpr.jaxpr.outvars, results, strict=True)):
            to = self._view(f"%result{k}", v.aval, row, writable=True)
            if not isinstance(x, np.ndarray) and x.size > THRESHOLDS.carried:
                memory.assign(to, x)
                continue
            for index in np.ndindex(v.aval.shape):
                store(code, to.buffer, memory.at(to, index), memory.entry(x, index))
        code.mask = before

    def _view(self, pointer: str, aval: Aval, row: Value | None, writable: bool) -> View:
        kind, parts = parts_of(aval.dtype)
        buffer = Buffer(pointer, kind, False, writable, parts)
        place = 0 if row is None else self.code.times(row, aval.size)
        return View(np.dtype(aval.dtype), aval.shape, buffer, row_major(aval.shape), place)

    def _elements(self) -> None:
        """The elements of one thread: from its first one on in steps of the number of threads."""
        code = self.code
        row, following, more, done = Value("%row", "i64"), "%row.next", code.name(), code.name()
        code.jump("next")
        code.label("next")
        here = len(code.lines)
        code.branch(code.op("icmp slt", "i64", row, Value("%batch", "i64"), result="i1"), more, done)
        code.label(more)
        with code.scope():
            self._store(self.lowering.run(self.jaxpr, self._arguments(row)), row, None)
        code.lines.append(f"{following} = add i64 {row.name}, %threads")
        phi = f"{row.name} = phi i64 [ %first, %start ], [ {following}, %{code.block} ]"
        code.lines.insert(here, phi)
        code.jump("next")
        code.label(done)

    def _batch(self, place: int | None) -> None:
        """All elements that this thread gets: threads take them from a counter, as they get on."""
        code, width = self.code, self.code.width
        size, last = Value("%batch", "i64"), Value("%batch.last", "i64")
        self.memory.stack += [
            *batch_size(f"arg{self.batched.index(True)}"),
            f"{last.name} = sub i64 {size.name}, 1",
        ]
        if place is not None:
            LaneQueue(self.lowering, self._arguments, self._store, size, last).write(self.jaxpr, place)
            return
        # A vector of elements at a time; the lanes that the last one has too many repeat the last element.
        lanes = Value("<" + ", ".join(f"i64 {k}" for k in range(width)) + ">", "i64", True)
        more, done = code.name(), code.name()
        code.jump("next")
        code.label("next")
        start = code.write(f"atomicrmw add ptr %taken, i64 {width} monotonic", "i64", False)
        code.branch(code.op("icmp slt", "i64", start, size, result="i1"), more, done)
        code.label(more)
        with code.scope():
            element = code.op("add", "i64", start, lanes)
            row = code.intrinsic("smin", "i64", element, last)
            inside = code.op("icmp sle", "i64", element, last, result="i1")
            self._store(self.lowering.run(self.jaxpr, self._arguments(row)), row, inside)
        code.jump("next")
        code.label(done)
