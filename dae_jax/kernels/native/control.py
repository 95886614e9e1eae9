"""Control flow of jaxprs as blocks of instructions.

With lanes each lane goes its own way: a loop runs until the last lane is done, branches run if any lane takes them, and
a mask says which lanes take part.
"""

import contextlib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Var

from ..entries import NotEntryByEntry, is_number, objects
from ..jaxprs import equations
from .dependence import depends_in_loop, depends_in_scan
from .instructions import Complex, Value, kind_of, parts
from .memory import View
from .primitives import CALLS, LARGE, SIMPLE, SMALL, Primitives


# A loop of a known number of turns is written out if that takes no more equations than these.
WRITTEN_OUT = 200

# Primitives of equinox that mean something to transformations only.
_TRANSPARENT = frozenset({"nonbatchable", "nontraceable", "nondifferentiable_backward", "unvmap_max"})


_OF_EQUINOX = frozenset({"select_if_vmap", "unvmap_any", "unvmap_all", "maybe_set"})
KNOWN = _TRANSPARENT | _OF_EQUINOX | CALLS.keys() | SIMPLE | {"while", "cond", "scan"}


class Control(Primitives):
    """Runs jaxprs with control flow."""

    def run(self, closed: ClosedJaxpr, args: list[Any]) -> list[Any]:
        jaxpr = closed.jaxpr
        last: dict[Any, int] = {}
        for i, eqn in enumerate(jaxpr.eqns):
            last.update((v, i) for v in eqn.invars if isinstance(v, Var))
        last.update((v, len(jaxpr.eqns)) for v in jaxpr.outvars if isinstance(v, Var))
        env: dict[Any, Any] = {}

        def bind(variables: Any, values: Any, now: int) -> None:
            for v, x in zip(variables, values, strict=True):
                if last.get(v, -1) > now:
                    env[v] = x
                    _refer(x, 1)

        def read(v: Any) -> Any:
            return self.constant(np.asarray(v.val, v.aval.dtype)) if isinstance(v, Literal) else env[v]

        bind(jaxpr.invars, args, -1)
        bind(jaxpr.constvars, map(self.constant, closed.consts), -1)
        for i, eqn in enumerate(jaxpr.eqns):
            values = [read(v) for v in eqn.invars]
            for v in {v for v in eqn.invars if isinstance(v, Var) and last[v] == i}:
                _refer(env.pop(v), -1)
            bind(eqn.outvars, self.equation(eqn, values), i)
            if len(self.code.lines) > self.limit:
                raise NotEntryByEntry("too many instructions")
        out = [read(v) for v in jaxpr.outvars]
        for x in env.values():
            _refer(x, -1)
        return out

    def equation(self, eqn: Any, args: list[Any]) -> list[Any]:
        name, p = eqn.primitive.name, eqn.params
        if eqn.effects:
            raise NotEntryByEntry(name)
        if name in CALLS:
            inner = p[CALLS[name]]
            return self.run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), args)
        if name in _TRANSPARENT:
            return args[:1]
        match name:
            case "while":
                return self._while(p, args)
            case "cond":
                return self._cond(eqn, args)
            case "scan":
                return self._scan(eqn, args)
            case "select_if_vmap":
                return [args[1]]
            case "unvmap_any" | "unvmap_all" if not args[0].ndim:
                return [args[0]]
            case "maybe_set" | "unvmap_any" | "unvmap_all":
                return self.run(_meaning(eqn), args)
        return super().equation(eqn, args)

    # Loops

    def _while(self, p: Any, args: list[Any]) -> list[Any]:
        code, n, m = self.code, p["cond_nconsts"], p["body_nconsts"]
        of_cond, of_body, first = args[:n], args[n : n + m], args[n + m :]
        for x in (*of_cond, *of_body):
            _refer(x, 1)
        own = (
            depends_in_loop(p, [list(map(has_lanes, xs)) for xs in (of_cond, of_body, first)]) if code.width > 1 else ()
        )
        avals = [v.aval for v in p["body_jaxpr"].jaxpr.invars[m:]]
        head, body, after, active = (code.name() for _ in range(4))
        carry = _Carry(self, avals, first, own)
        entered, mask = code.block, code.mask
        everyone = code.text(mask, "i1", True) if mask else "splat (i1 true)"
        code.jump(head)
        code.label(head)
        here = len(code.lines)
        inside = contextlib.ExitStack()
        inside.enter_context(code.scope())
        for x in carry.values:
            _refer(x, 1)
        (goes_on,) = self.run(p["cond_jaxpr"], [*of_cond, *carry.values])
        for x in carry.values:
            _refer(x, -1)
        more = code.copy(goes_on[()], "i1")
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
            _refer(x, -1)
        return carry.values

    def _scan(self, eqn: Any, args: list[Any]) -> list[Any]:
        code, p = self.code, eqn.params
        n, m, length, inner = p["num_consts"], p["num_carry"], p["length"], p["jaxpr"]
        consts, first, xs = args[:n], args[n : n + m], args[n + m :]
        of_ys = [v.aval for v in eqn.outvars[m:]]
        total = length * (1 + sum(1 for _ in equations(inner)))
        if (total <= WRITTEN_OUT and all(y.size <= LARGE for y in of_ys)) or length <= 1:
            return self._written_out(inner, consts, first, list(map(code.entries, xs)), length, p["reverse"], of_ys)
        for x in (*consts, *xs):
            _refer(x, 1)
        rows = [code.memory(x, v.aval.dtype) for x, v in zip(xs, eqn.invars[n + m :], strict=True)]
        ys = [code.new(a.dtype, a.shape) for a in of_ys]
        own = ()
        if code.width > 1:
            own = depends_in_scan(inner, [list(map(has_lanes, consts)), list(map(has_lanes, first)), [True] * len(xs)])
        carry = _Carry(self, [v.aval for v in inner.jaxpr.invars[n : n + m]], first, own)
        entered, phis = code.block, []
        with code.loop(length, phis) as i:
            at = code.op("sub", "i64", length - 1, i) if p["reverse"] else i
            now = [code.row(x, at) for x in rows]
            out = self.run(inner, [*consts, *carry.values, *(x if x.size > SMALL else code.entries(x) for x in now)])
            with code.unmasked():
                for y, value in zip(ys, out[m:], strict=True):
                    code.assign(code.row(y, at), value)
            phis += carry.turn(out[:m], entered, None)
        for x in (*consts, *xs):
            _refer(x, -1)
        return [*carry.values, *ys]

    def _written_out(
        self, inner: ClosedJaxpr, consts: Any, carry: Any, xs: Any, length: int, reverse: bool, of_ys: Any
    ) -> list[Any]:
        for x in consts:
            _refer(x, 1)
        rows: list[Any] = [None] * length
        for i in reversed(range(length)) if reverse else range(length):
            out = self.run(
                inner,
                [*consts, *carry, *(objects(list(x[i].ravel()) if x.ndim > 1 else [x[i]], x.shape[1:]) for x in xs)],
            )
            carry, rows[i] = out[: len(carry)], list(map(self.code.entries, out[len(carry) :]))
        for x in consts:
            _refer(x, -1)
        ys = [objects([e for row in rows for e in row[k].ravel()], a.shape) for k, a in enumerate(of_ys)]
        return [*carry, *ys]

    # Branches

    def _cond(self, eqn: Any, args: list[Any]) -> list[Any]:
        code, (which, *operands) = self.code, args
        branches = eqn.params["branches"]
        index = which[()]
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
        lines, before = code.lines, code.block
        found, texts, starts, ends = [], [], [], []
        for branch, here in zip(branches, taken, strict=True):
            code.lines = []
            starts.append(code.name())
            code.label(starts[-1])
            code.mask = here if here.lanes else mask
            with code.scope():
                found.append(self.run(branch, operands))
            texts.append(code.lines)
            ends.append(code.block)
        code.lines, code.block, code.mask = lines, before, mask
        outs = [
            _Merged(self, v.aval, list(values), any(here.lanes for here in taken))
            for v, values in zip(eqn.outvars, zip(*found, strict=True), strict=True)
        ]
        for k, here in enumerate(taken):
            after, skipped = code.name(), code.block
            code.lines.append(f"br i1 {code.any(here).name}, label %{starts[k]}, label %{after}")
            code.lines += texts[k]
            code.block, code.mask = ends[k], here if here.lanes else mask
            with code.scope():
                for out in outs:
                    out.deliver(k, here)
            end, code.mask = code.block, mask
            code.jump(after)
            code.label(after)
            for out in outs:
                out.join(end, skipped)
        return [out.value() for out in outs]

    def texts(self, aval: Any, x: np.ndarray, lanes: bool) -> list[str]:
        """The operands that hold the entries, one for each part of a number."""
        numbers = [y for e in x.ravel() for y in (parts(e) if np.dtype(aval.dtype).kind == "c" else (e,))]
        if not lanes and any(isinstance(y, Value) and y.lanes for y in numbers):
            raise NotEntryByEntry("a number of each lane where one for all is expected")
        return [self.code.text(y, kind, lanes) for y, kind in zip(numbers, _parts_of(aval), strict=True)]


class _Merged:
    """What branches give: entries as phi nodes, large arrays in the buffer that all share or in a new one."""

    def __init__(self, run: Control, aval: Any, values: list[Any], each: bool) -> None:
        self.run, self.aval, self.values = run, aval, values
        self.lanes = each or any(map(has_lanes, values))
        self.kinds = [] if aval.size > SMALL else _parts_of(aval)
        self.texts = ["zeroinitializer" if self.lanes else "poison"] * len(self.kinds)
        self.view: View | None = None
        if aval.size > SMALL:
            first = values[0]
            shared = all(isinstance(x, View) and x.buffer is first.buffer and x.whole for x in values)
            self.view = first if shared else run.code.new(aval.dtype, aval.shape)

    def deliver(self, k: int, taken: Value) -> None:
        """The end of a branch."""
        code, x = self.run.code, self.values[k]
        self.before = self.texts
        if self.view is not None:
            if not (isinstance(x, View) and x.buffer is self.view.buffer):
                code.assign(self.view, x)
            return
        self.texts = self.run.texts(self.aval, code.entries(x), self.lanes)
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
        return _of_texts(self.texts, self.aval, self.lanes) if self.view is None else self.view


class _Carry:
    """What a loop hands from one turn to the next: entries as phi nodes, large arrays in a buffer of the loop's own."""

    def __init__(self, run: Control, avals: list[Any], first: list[Any], lanes: Sequence[bool]) -> None:
        self.run, self.avals = run, avals
        self.lanes = list(lanes) or [False] * len(avals)
        self.values: list[Any] = []
        self.names: list[list[str]] = []
        self.first: list[list[str]] = []
        for aval, x, each in zip(avals, first, self.lanes, strict=True):
            if aval.size > SMALL:
                x = run.own(x, aval.dtype)
                _refer(x, 1)
                self.names.append([])
                self.first.append([])
            else:
                self.first.append(run.texts(aval, run.code.entries(x), each))
                self.names.append([f"%{run.code.name()}" for _ in _parts_of(aval)])
                x = _of_texts(self.names[-1], aval, each)
            self.values.append(x)
        for x in self.values:
            _refer(x, -1)

    def turn(self, new: list[Any], entered: str, mask: Value | None) -> list[str]:
        """The end of a turn; gives the phi nodes at its beginning."""
        code, phis = self.run.code, []
        # A buffer may hold what another one gets.
        new = [
            code.copied(x, a.dtype) if isinstance(own, View) and self._moves(x, own) else x
            for x, own, a in zip(new, self.values, self.avals, strict=True)
        ]
        following = []
        for aval, x, own, names, each in zip(self.avals, new, self.values, self.names, self.lanes, strict=True):
            if isinstance(own, View):
                if not (isinstance(x, View) and x.buffer is own.buffer):
                    code.assign(own, x)
                following.append([])
                continue
            texts = self.run.texts(aval, code.entries(x), each)
            if mask is not None:
                texts = [
                    y if y == z else code.write(
                        f"select {code.type('i1', True)} {mask.name}, {code.type(kind, True)} {y}, {code.type(kind, True)} {z}",
                        kind, True,
                    ).name
                    for y, z, kind in zip(texts, names, _parts_of(aval), strict=True)
                ]  # fmt: skip
            following.append(texts)
        for aval, names, before, after, each in zip(
            self.avals, self.names, self.first, following, self.lanes, strict=True
        ):
            kinds = _parts_of(aval) if names else []
            for name, x, y, kind in zip(names, before, after, kinds, strict=True):
                vector = code.type(kind, each)
                phis.append(f"{name} = phi {vector} [ {x}, %{entered} ], [ {y}, %{code.block} ]")
        return phis

    def _moves(self, x: Any, own: View) -> bool:
        held = {v.buffer for v in self.values if isinstance(v, View)}
        return isinstance(x, View) and x.buffer in held and not (x.buffer is own.buffer and x.whole)


def _refer(x: Any, by: int) -> None:
    if isinstance(x, View):
        x.buffer.references += by


def has_lanes(x: Any) -> bool:
    """Whether an array's entries may differ from lane to lane."""
    if isinstance(x, View):
        return x.buffer.lanes or (isinstance(x.offset, Value) and x.offset.lanes)
    return any(
        isinstance(p, Value) and p.lanes for e in x.ravel() for p in (parts(e) if isinstance(e, Complex) else (e,))
    )


def _parts_of(aval: Any) -> list[str]:
    """The LLVM types of an array's numbers, two for a complex one."""
    dtype = np.dtype(aval.dtype)
    if dtype.kind == "c":
        return [kind_of(f"float{4 * dtype.itemsize}")] * (2 * aval.size)
    return [kind_of(dtype)] * aval.size


def _of_texts(names: list[str], aval: Any, lanes: bool) -> np.ndarray:
    """Entries from the operands that hold them."""
    values = [Value(name, kind, lanes) for name, kind in zip(names, _parts_of(aval), strict=True)]
    if np.dtype(aval.dtype).kind == "c":
        values = [Complex(*pair) for pair in zip(values[::2], values[1::2], strict=True)]
    return objects(values, aval.shape)


def _meaning(eqn: Any) -> ClosedJaxpr:
    """A primitive of equinox by others."""
    structs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
    return jax.make_jaxpr(lambda *xs: eqn.primitive.impl(*xs, **eqn.params))(*structs)
