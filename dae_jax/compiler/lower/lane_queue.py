"""Batches whose lanes take a new element as soon as they are done with one.

The main loop of a function is taken apart from what comes before and after it. A lane that has left the loop waits until
what the waiting lanes have cost is worth a compaction: what comes after the loop, for them; then the next elements, and
what comes before the loop. So a lane with many steps does not hold up the others.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from ..jaxprs.objects import objects
from ..jaxprs.walk import equations, equations_in
from ..thresholds import THRESHOLDS
from ..types import Aval, Params
from .arrays import Operand, View
from .carry import kept_apart
from .dtypes import kinds_of
from .environment import Environment
from .lowering import Lowering
from .operands import has_lanes, of_texts, retain, texts
from .uniformity import varying_in_loop
from .values import Complex, Number, Value


class NotQueued(Exception):
    """The lanes of this loop had better take their elements together."""


def main_loop(jaxpr: ClosedJaxpr) -> int | None:
    """Where in a jaxpr without calls the loop is that does most of the work; `None` where none does more than half."""
    total = len(equations(jaxpr))
    sizes = [len(equations_in(eqn)) for eqn in jaxpr.jaxpr.eqns]
    place = int(np.argmax([0, *sizes])) - 1
    is_loop = place >= 0 and jaxpr.jaxpr.eqns[place].primitive.name == "while"
    return place if is_loop and sizes[place] > total / 2 else None


class LaneQueue:
    """The loop over all elements of a batch, by one thread.

    `arguments(row)` gives a function's arguments for the element of each lane, `put(results, row, mask)` stores its
    results; `size` is the number of elements, `last` the last one. Elements are taken from the counter %taken.
    """

    def __init__(
        self,
        lowering: Lowering,
        arguments: Callable[[Value], list[Any]],
        put: Callable[[list[Any], Value, Value], None],
        size: Value,
        last: Value,
    ) -> None:
        self.lowering, self.code, self.memory = lowering, lowering.code, lowering.memory
        self.arguments, self.put, self.size, self.last = arguments, put, size, last
        # (name, LLVM type, operand at the entry, after a compaction, after a turn) of each phi node.
        self.phis: list[list[str]] = []

    def write(self, jaxpr: ClosedJaxpr, place: int) -> None:
        """Writes the loop."""
        code = self.code
        # What is written first is run last.
        self.memory.recycles = False
        head, compaction, onwards, body, done = (code.name() for _ in range(5))
        row = Value(self._phi(code.type("i64", True), "splat (i64 -1)"), "i64", True)
        idle = Value(self._phi("i64", "0"), "i64")
        self.free = Value(f"%{code.name()}", "i1", True)
        entered = code.block
        code.jump(head)

        # The compaction is written first, since it shows what there is to keep; it comes after the head.
        before, code.lines = code.lines, []
        code.label(compaction)
        with code.scope():
            p, consts = self._compact(jaxpr, place, row)
            self.phis[1][3] = "0"
            compacted = code.block
            code.jump(head)
        compaction_lines, code.lines = code.lines, before

        code.label(head)
        here = len(code.lines)
        with code.scope():
            self._turn(p, consts, row, idle, (compaction, onwards, body, done))
            end = code.block
            code.jump(head)
        code.lines[here:here] = [
            f"{name} = phi {kind} [ {a}, %{entered} ], [ {b or name}, %{compacted} ], [ {c or name}, %{end} ]"
            for name, kind, a, b, c in self.phis
        ]
        code.lines += compaction_lines
        code.label(done)
        code.mask = None

    def _turn(
        self, p: Params, consts: list[Operand], row: Value, idle: Value, blocks: tuple[str, str, str, str]
    ) -> None:
        """A turn of the lanes whose condition holds, unless a compaction is due or all are done."""
        code, n = self.code, p["cond_nconsts"]
        compaction, onwards, body, done = blocks
        code.mask = code.op("icmp ult", "i64", row, self.size, result="i1")
        for x in (*consts, *self.carry):
            retain(x, 1)
        (goes_on,) = self.lowering.run(p["cond_jaxpr"], [*consts[:n], *self.carry])
        for x in self.carry:
            retain(x, -1)
        goes_on = code.in_lanes(code.copy(self.memory.number(goes_on), "i1"))
        going = code.op("and", "i1", code.mask, goes_on)
        code.lines.append(f"{self.free.name} = xor {code.type('i1', True)} {going.name}, splat (i1 true)")
        now, idled = self._compaction_due(code.mask, going, row, idle)
        code.branch(now, compaction, onwards)
        code.label(onwards)
        code.branch(code.any(going), body, done)
        code.label(body)
        code.mask = going
        out = self.lowering.run(p["body_jaxpr"], [*consts[n:], *self.carry])
        self._replace(kept_apart(self.memory, out, self.carry, self.avals), going, 4)
        self.phis[1][4] = idled.name
        for x in consts:
            retain(x, -1)

    def _compaction_due(self, alive: Value, going: Value, row: Value, idle: Value) -> tuple[Value, Value]:
        """Whether the waiting lanes have cost what a compaction does, and how many turns they have waited."""
        code = self.code
        finished = code.op("and", "i1", alive, self.free)
        bits = code.cast("bitcast", finished, f"i{code.width}", True)
        waiting = code.cast("zext", code.intrinsic("ctpop", f"i{code.width}", bits), "i64")
        idled = code.op("add", "i64", idle, waiting)
        none = code.op("xor", "i1", code.any(going), np.True_)
        impatient = code.op("icmp sge", "i64", idled, THRESHOLDS.compaction * code.width, result="i1")
        due = code.op("and", "i1", code.any(finished), code.op("or", "i1", none, impatient))
        fresh = code.op("icmp eq", "i64", code.lane(row, "i64", 0), -1, result="i1")
        return code.op("or", "i1", fresh, due), idled

    def _phi(self, kind: str, first: str) -> str:
        """A phi node; it keeps its value where nothing else is said."""
        self.phis.append([f"%{self.code.name()}", kind, first, "", ""])
        return self.phis[-1][0]

    def _compact(self, jaxpr: ClosedJaxpr, place: int, row: Value) -> tuple[Any, list[Any]]:
        code, free = self.code, self.free
        following = code.select(free, self._next(), row, "i64")
        self.phis[0][3] = following.name
        environment = Environment(
            self.lowering, jaxpr, self.arguments(code.intrinsic("smin", "i64", following, self.last))
        )
        environment.advance(0, place)
        values, eqn = environment.operands(place), jaxpr.jaxpr.eqns[place]
        values = list(map(self.memory.materialised, values))
        p = eqn.params
        count = p["cond_nconsts"] + p["body_nconsts"]
        first, self.avals = values[count:], [v.aval for v in eqn.outvars]
        own = [
            list(map(has_lanes, xs)) for xs in (values[: p["cond_nconsts"]], values[p["cond_nconsts"] : count], first)
        ]
        if not all(varying_in_loop(p, own)):
            raise NotQueued("a loop that is as long for all lanes")
        self.carry = [self._carried(aval) for aval in self.avals]
        new: list[tuple[Any, Any]] = []
        consts = [self._kept(x, new) for x in values[:count]]
        environment.values = {v: self._kept(self.memory.materialised(x), new) for v, x in environment.values.items()}

        # What comes after the loop, in the lanes that are done with it.
        alive = code.op("icmp ult", "i64", row, self.size, result="i1")
        code.mask = code.op("and", "i1", free, alive)
        environment.give(place, self.carry)
        environment.advance(place + 1, len(environment.jaxpr.eqns))
        self.put(environment.results(), row, code.op("and", "i1", free, alive))

        code.mask = free
        for phi, x in new:
            phi[3] = x.name if not x.lanes else code.select(free, x, Value(phi[0], x.kind, True), x.kind).name
        self._replace(first, free, 3)
        code.mask = None
        return p, consts

    def _next(self) -> Value:
        """The next element for each free lane: the counter, and a free lane's place among the free ones."""
        code, width = self.code, self.code.width
        one = code.cast("zext", self.free, "i64")
        total, step = one, 1
        while step < width:
            lanes = ", ".join(f"i32 {k - step if k >= step else width}" for k in range(width))
            vector = code.type("i64", True)
            moved = code.pure(
                f"shufflevector {vector} {total.name}, {vector} zeroinitializer, <{width} x i32> <{lanes}>", "i64", True
            )
            total, step = code.op("add", "i64", total, moved), 2 * step
        count = code.lane(total, "i64", width - 1)
        start = code.write(f"atomicrmw add ptr %taken, i64 {count.name} monotonic", "i64", False)
        return code.op("add", "i64", code.op("sub", "i64", total, one), start)

    def _carried(self, aval: Aval) -> Any:
        """What the loop carries: entries as phi nodes, large arrays in a buffer of the loop's own."""
        code = self.code
        if aval.size > THRESHOLDS.carried:
            return self.memory.new(aval.dtype, aval.shape)
        names = [self._phi(code.type(kind, True), "zeroinitializer") for kind in kinds_of(aval)]
        return of_texts(names, aval, True)

    def _kept(self, x: Operand, new: list[tuple[list[str], Value]]) -> Any:
        """A value from before the loop that is needed later."""
        if isinstance(x, View):
            if x.buffer.lanes:
                raise NotQueued("a large array from before the loop")
            return dataclasses.replace(x, offset=self._kept_part(x.offset, new))
        entries = [
            Complex(self._kept_part(e.real, new), self._kept_part(e.imag, new))
            if isinstance(e, Complex)
            else self._kept_part(e, new)
            for e in self.memory.entries(x).ravel()
        ]
        return objects(entries, x.shape)

    def _kept_part(self, x: Number, new: list[tuple[list[str], Value]]) -> Any:
        if not isinstance(x, Value):
            return x
        code = self.code
        name = self._phi(code.type(x.kind, x.lanes), "zeroinitializer" if x.lanes else code.text(0, x.kind))
        new.append((self.phis[-1], x))
        return Value(name, x.kind, x.lanes)

    def _replace(self, values: list[Operand], mask: Value, edge: int) -> None:
        """What is carried, replaced in some lanes."""
        code = self.code
        phis = {phi[0]: phi for phi in self.phis}
        for aval, x, own in zip(self.avals, values, self.carry, strict=True):
            if isinstance(own, View):
                if not (isinstance(x, View) and x.buffer is own.buffer):
                    self.memory.assign(own, x)
                continue
            names = texts(code, aval, own, True)
            for name, y, kind in zip(
                names, texts(code, aval, self.memory.entries(x), True), kinds_of(aval), strict=True
            ):
                vector = code.type(kind, True)
                chosen = f"select {code.type('i1', True)} {mask.name}, {vector} {y}, {vector} {name}"
                phis[name][edge] = name if y == name else code.pure(chosen, kind, True).name
