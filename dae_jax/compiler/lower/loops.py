"""Loops of jaxprs. With lanes a loop runs until the last lane is done, and a mask says which lanes take part."""

import contextlib
from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr

from ..jaxprs.scalar_interpreter import objects
from ..jaxprs.walk import equations
from .arrays import SMALL, View
from .in_memory import LARGE
from .instructions import Value
from .memory import Memory
from .operands import has_lanes, kinds_of, of_texts, retain, texts
from .primitives import Primitives
from .uniformity import varying_in_loop, varying_in_scan


# A loop of a known number of turns is written out if that takes no more equations than these.
WRITTEN_OUT = 200


class Loops(Primitives):
    """Runs `while` and `scan`."""

    def _while(self, p: Any, args: list[Any]) -> list[Any]:
        code, n, m = self.code, p["cond_nconsts"], p["body_nconsts"]
        of_cond, of_body, first = args[:n], args[n : n + m], args[n + m :]
        for x in (*of_cond, *of_body):
            retain(x, 1)
        own = (
            varying_in_loop(p, [list(map(has_lanes, xs)) for xs in (of_cond, of_body, first)]) if code.width > 1 else ()
        )
        avals = [v.aval for v in p["body_jaxpr"].jaxpr.invars[m:]]
        head, body, after, active = (code.name() for _ in range(4))
        carry = Carry(self, avals, first, own)
        entered, mask = code.block, code.mask
        everyone = code.text(mask, "i1", True) if mask else "splat (i1 true)"
        code.jump(head)
        code.label(head)
        here = len(code.lines)
        inside = contextlib.ExitStack()
        inside.enter_context(code.scope())
        for x in carry.values:
            retain(x, 1)
        (goes_on,) = self.run(p["cond_jaxpr"], [*of_cond, *carry.values])
        for x in carry.values:
            retain(x, -1)
        more = code.copy(code.entries(goes_on)[()], "i1")
        each = any(own) and more.lanes
        if each:
            code.mask = code.op("and", "i1", more, Value(f"%{active}", "i1", True))
            more = code.any(code.mask)
        running = code.mask
        code.lines.append(f"br i1 {more.name}, label %{body}, label %{after}")
        code.label(body)
        phis = carry.turn(self.run(p["body_jaxpr"], [*of_body, *carry.values]), entered, running if each else None)
        if each and running:
            phis.append(
                f"%{active} = phi {code.type('i1', True)} [ {everyone}, %{entered} ], [ {running.name}, %{code.block} ]"
            )
        code.lines[here:here] = phis
        code.jump(head)
        inside.close()
        code.label(after)
        code.mask = mask
        for x in (*of_cond, *of_body):
            retain(x, -1)
        return carry.values

    def _scan(self, eqn: Any, args: list[Any]) -> list[Any]:
        code, p = self.code, eqn.params
        n, m, length, inner = p["num_consts"], p["num_carry"], p["length"], p["jaxpr"]
        consts, first, xs = args[:n], args[n : n + m], args[n + m :]
        of_ys = [v.aval for v in eqn.outvars[m:]]
        total = length * (1 + sum(1 for _ in equations(inner)))
        if (total <= WRITTEN_OUT and all(y.size <= LARGE for y in of_ys)) or length <= 1:
            return self._written_out(inner, consts, first, list(map(code.entries, xs)), length, p["reverse"], of_ys)
        rows = [code.memory(x, v.aval.dtype) for x, v in zip(xs, eqn.invars[n + m :], strict=True)]
        for x in (*consts, *rows):
            retain(x, 1)
        ys = [code.new(a.dtype, a.shape) for a in of_ys]
        own = ()
        if code.width > 1:
            own = varying_in_scan(inner, [list(map(has_lanes, consts)), list(map(has_lanes, first)), [True] * len(xs)])
        carry = Carry(self, [v.aval for v in inner.jaxpr.invars[n : n + m]], first, own)
        entered, phis = code.block, []
        with code.loop(length, phis) as i:
            at = code.op("sub", "i64", length - 1, i) if p["reverse"] else i
            now = [code.row(x, at) for x in rows]
            out = self.run(inner, [*consts, *carry.values, *(x if x.size > SMALL else code.entries(x) for x in now)])
            for y, value in zip(ys, out[m:], strict=True):
                code.assign(code.row(y, at), value, fresh=True)
            phis += carry.turn(out[:m], entered, None)
        for x in (*consts, *rows):
            retain(x, -1)
        return [*carry.values, *ys]

    def _written_out(
        self, inner: ClosedJaxpr, consts: Any, carry: Any, xs: Any, length: int, reverse: bool, of_ys: Any
    ) -> list[Any]:
        for x in consts:
            retain(x, 1)
        rows: list[Any] = [None] * length
        for i in reversed(range(length)) if reverse else range(length):
            out = self.run(
                inner,
                [*consts, *carry, *(objects(list(x[i].ravel()) if x.ndim > 1 else [x[i]], x.shape[1:]) for x in xs)],
            )
            carry, rows[i] = out[: len(carry)], list(map(self.code.entries, out[len(carry) :]))
        for x in consts:
            retain(x, -1)
        ys = [objects([e for row in rows for e in row[k].ravel()], a.shape) for k, a in enumerate(of_ys)]
        return [*carry, *ys]


class Carry:
    """What a loop hands from one turn to the next: entries as phi nodes, large arrays in a buffer of the loop's own."""

    def __init__(self, run: Primitives, avals: list[Any], first: list[Any], lanes: Sequence[bool]) -> None:
        self.run, self.avals = run, avals
        self.lanes = list(lanes) or [False] * len(avals)
        self.values: list[Any] = []
        self.names: list[list[str]] = []
        self.first: list[list[str]] = []
        for aval, x, each in zip(avals, first, self.lanes, strict=True):
            if aval.size > SMALL:
                x = run.own(x, aval.dtype)
                retain(x, 1)
                x.buffer.held = True
                self.names.append([])
                self.first.append([])
            else:
                self.first.append(texts(run.code, aval, run.code.entries(x), each))
                self.names.append([f"%{run.code.name()}" for _ in kinds_of(aval)])
                x = of_texts(self.names[-1], aval, each)
            self.values.append(x)
        for x in self.values:
            retain(x, -1)

    def turn(self, new: list[Any], entered: str, mask: Value | None) -> list[str]:
        """The end of a turn; gives the phi nodes at its beginning."""
        code, phis = self.run.code, []
        new = kept_apart(code, new, self.values, self.avals)
        following = []
        for aval, x, own, names, each in zip(self.avals, new, self.values, self.names, self.lanes, strict=True):
            if isinstance(own, View):
                if not (isinstance(x, View) and x.buffer is own.buffer):
                    code.assign(own, x)
                following.append([])
                continue
            found = texts(code, aval, code.entries(x), each)
            if mask is not None:
                found = [
                    y if y == z else code.write(
                        f"select {code.type('i1', True)} {mask.name}, {code.type(kind, True)} {y}, {code.type(kind, True)} {z}",
                        kind, True,
                    ).name
                    for y, z, kind in zip(found, names, kinds_of(aval), strict=True)
                ]  # fmt: skip
            following.append(found)
        for aval, names, before, after, each in zip(
            self.avals, self.names, self.first, following, self.lanes, strict=True
        ):
            kinds = kinds_of(aval) if names else []
            for name, x, y, kind in zip(names, before, after, kinds, strict=True):
                vector = code.type(kind, each)
                phis.append(f"{name} = phi {vector} [ {x}, %{entered} ], [ {y}, %{code.block} ]")
        return phis


def kept_apart(code: Memory, new: list[Any], carry: list[Any], avals: list[Any]) -> list[Any]:
    """What a turn gives, copied where it lies in a buffer of the loop's that gets something else."""
    new = list(map(code.materialised, new))
    held = {x.buffer for x in carry if isinstance(x, View)}

    def overwritten(x: Any, own: Any) -> bool:
        return isinstance(x, View) and x.buffer in held and not (x.buffer is own.buffer and x.whole)

    return [
        code.copied(x, aval.dtype) if isinstance(own, View) and overwritten(x, own) else x
        for x, own, aval in zip(new, carry, avals, strict=True)
    ]
