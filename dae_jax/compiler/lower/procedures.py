"""Functions that are called: each is written once for each form of its arguments.

A few entries are handed over in registers, arrays by their address, and arguments of the kernel itself not at all: the procedure
reads them where the kernel does. Few entries that are known are known inside, and belong to the form. Results go into memory of
the caller's, and so do arrays of the procedure's own that the stack is too small for.
"""

import dataclasses
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Var

from ..emit.interface import buffer as found_at
from ..emit.runtime import procedure
from ..jaxprs.objects import is_number
from ..jaxprs.walk import identity
from ..thresholds import THRESHOLDS
from ..types import Aval
from .access import address_of, store
from .arrays import Buffer, Operand, View, row_major
from .dtypes import kinds_of, parts_of
from .operands import has_lanes, of_texts, texts
from .values import Value


if TYPE_CHECKING:
    from .lowering import Lowering


@dataclasses.dataclass(frozen=True)
class _Argument:
    """An argument: its `form`, and the types and the operands that it is handed over by.

    - `known`: its numbers, where these are known; `place`: that of the kernel's argument that it is, from 0 on, or −1.
    - `lanes`: whether it differs from lane to lane; `view`: an array in memory, whose kind of buffer the procedure needs.
    """

    form: Hashable
    types: Sequence[str] = ()
    operands: Sequence[str] = ()
    known: np.ndarray | None = None
    place: int = -1
    lanes: bool = False
    view: View | None = None


@dataclasses.dataclass(frozen=True)
class _Result:
    """What is `known` of a result, or whether it differs from lane to lane in memory."""

    known: np.ndarray | None
    lanes: bool


@dataclasses.dataclass(frozen=True)
class _Procedure:
    """`heap`: bytes of memory that it needs of its caller."""

    name: str
    results: list[_Result]
    heap: int


class Procedures:
    """Those of a module; `lines` are their instructions."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._count = 0
        # Those of a function, with the form of their arguments. The functions are kept, so that none has the identity of another.
        self._known: dict[Hashable, list[tuple[ClosedJaxpr, tuple[Hashable, ...], _Procedure]]] = {}

    def call(self, caller: "Lowering", closed: ClosedJaxpr, args: Sequence[Operand]) -> list[Any]:
        """Writes a call, and the procedure where there is none yet of this form; gives its results."""
        code, memory = caller.code, caller.memory
        temporary: list[Buffer] = []
        avals = [v.aval for v in closed.jaxpr.invars]
        handed = {k: _handed(caller, args[k], avals[k], temporary) for k in _used(caller.inlined(closed))}
        known = self._known.setdefault((identity(closed), code.mask is None), [])
        found = next((x for x in known if _takes(x[1], handed)), None)
        if found is None:
            found = closed, tuple(each.form for each in handed.values()), self._written(caller, closed, handed)
            known.append(found)
        _, forms, made = found
        passed = [
            each if form == each.form else _as_entries(caller, args[k], avals[k])
            for form, (k, each) in zip(forms, handed.items(), strict=True)
        ]
        operands = ["ptr %args"]
        operands += [f"{kind} {x}" for each in passed for kind, x in zip(each.types, each.operands, strict=True)]
        if code.mask is not None:
            operands.append(f"{code.type('i1', True)} {code.text(code.mask, 'i1', True)}")
        outs = []
        for v, result in zip(closed.jaxpr.outvars, made.results, strict=True):
            if result.known is not None:
                outs.append(caller.constant(result.known))
                continue
            out = memory.new(v.aval.dtype, v.aval.shape)
            out.buffer.lanes = result.lanes
            outs.append(out)
            operands.append(f"ptr {out.buffer.pointer}")
        if made.heap:
            room = memory.new(np.uint8, [-(-made.heap // code.width)])
            temporary.append(room.buffer)
            operands.append(f"ptr {room.buffer.pointer}")
        code.lines.append(f"call fastcc void {made.name}({', '.join(operands)})")
        for k, out in enumerate(outs):
            if isinstance(out, View) and out.size <= THRESHOLDS.carried:
                temporary.append(out.buffer)
                outs[k] = memory.entries(out)
        memory.recycle(temporary)
        return outs

    def _written(self, caller: "Lowering", closed: ClosedJaxpr, handed: dict[int, _Argument]) -> _Procedure:
        self._count += 1
        name = f"@{{name}}.procedure{self._count}"
        inner = caller.within(f"p{self._count}.")
        code, memory = inner.code, inner.memory
        parameters, found, args = ["ptr %args"], [], []
        code.block = "start"
        for k, v in enumerate(closed.jaxpr.invars):
            if k not in handed:
                args.append(np.empty(v.aval.shape, object))
                continue
            each = handed[k]
            names = [f"%{code.name()}" for _ in each.types]
            parameters += [f"{kind} {x}" for kind, x in zip(each.types, names, strict=True)]
            if each.place >= 0:
                found += found_at("%args", each.place, f"arg{each.place}")
            args.append(_inside(inner, each, v.aval, names))
        if caller.code.mask is not None:
            code.mask = Value("%mask", "i1", True)
            parameters.append(f"{code.type('i1', True)} %mask")
        results = []
        for k, (v, x) in enumerate(zip(closed.jaxpr.outvars, inner.run(closed, args), strict=True)):
            x = memory.materialised(x)
            lanes = code.width > 1 and (v.aval.size > THRESHOLDS.carried or has_lanes(x))
            results.append(_Result(_known(x, v.aval), lanes))
            if results[-1].known is None:
                parameters.append(f"ptr noalias %result{k}")
                _give(inner, f"%result{k}", v.aval, x, lanes)
        if memory.heap:
            parameters.append("ptr noalias %heap")
        body = [*dict.fromkeys(found), *memory.stack, *memory.on_heap, "br label %start", "start:", *code.lines]
        self.lines += procedure(name, parameters, body, code.width == 1 and code.longest >= THRESHOLDS.long_loop)
        return _Procedure(name, results, memory.heap)


def _used(inlined: ClosedJaxpr) -> list[int]:
    """Which arguments a function without calls reads."""
    read = {v for eqn in inlined.jaxpr.eqns for v in eqn.invars if isinstance(v, Var)}
    read.update(v for v in inlined.jaxpr.outvars if isinstance(v, Var))
    return [k for k, v in enumerate(inlined.jaxpr.invars) if v in read]


# Of what is the same in all lanes, where it is small.
_SAME = "entries", False


def _takes(forms: Sequence[Hashable], handed: dict[int, _Argument]) -> bool:
    """Whether a procedure with arguments of these forms can be called: what is known, or the kernel's, goes as other numbers do."""
    special = lambda each: each.known is not None or each.place >= 0
    return all(
        form == each.form or (form == _SAME and special(each))
        for form, each in zip(forms, handed.values(), strict=True)
    )


def _as_entries(caller: "Lowering", x: Operand, aval: Aval) -> _Argument:
    entries = caller.memory.entries(caller.memory.materialised(x))
    lanes = has_lanes(entries)
    types = [caller.code.type(kind, lanes) for kind in kinds_of(aval)]
    return _Argument(("entries", lanes), types, texts(caller.code, aval, entries, lanes), lanes=lanes)


def _handed(caller: "Lowering", x: Operand, aval: Aval, temporary: list[Buffer]) -> _Argument:
    code, memory = caller.code, caller.memory
    place = caller.place_of(x)
    if place >= 0:
        return _Argument(("place", place), place=place)
    x = memory.materialised(x)
    known = _known(x, aval) if x.size <= THRESHOLDS.carried else None
    if known is not None:
        return _Argument(("known", known.dtype, known.shape, known.tobytes()), known=known)
    if x.size <= THRESHOLDS.carried:
        return _as_entries(caller, x, aval)
    view = memory.view(x, aval.dtype)
    if not view.contiguous or (isinstance(view.offset, Value) and view.offset.lanes):
        view = memory.copied(view, aval.dtype)
    if view is not x:
        temporary.append(view.buffer)
    own = view.buffer
    form = "array", own.lanes, own.plane if own.parts > 1 else 0
    return _Argument(form, ["ptr"], [address_of(code, own, view.offset)], view=view)


def _inside(inner: "Lowering", each: _Argument, aval: Aval, names: list[str]) -> Operand:
    """What a procedure has of an argument whose operands it calls by these names."""
    if each.place >= 0:
        return inner.argument(each.place, aval)
    if each.known is not None:
        return inner.constant(each.known)
    if each.view is None:
        return of_texts(names, aval, each.lanes)
    buffer = dataclasses.replace(each.view.buffer, pointer=names[0], writable=False, bytes=0, references=0, held=False)
    return dataclasses.replace(each.view, buffer=buffer, offset=0)


def _known(x: Operand, aval: Aval) -> np.ndarray | None:
    """An array of known numbers."""
    if not isinstance(x, np.ndarray) or not all(map(is_number, x.ravel())):
        return None
    return np.array(list(x.ravel()), aval.dtype).reshape(x.shape)


def _give(inner: "Lowering", pointer: str, aval: Aval, x: Operand, lanes: bool) -> None:
    """Stores a result in memory that nothing else sees yet."""
    kind, parts = parts_of(aval.dtype)
    buffer = Buffer(pointer, kind, lanes, parts=parts, plane=max(aval.size, 1))
    to = View(np.dtype(aval.dtype), aval.shape, buffer, row_major(aval.shape))
    if aval.size > THRESHOLDS.carried:
        inner.memory.assign(to, x, fresh=True)
        return
    with inner.code.unmasked():
        for k, number in enumerate(inner.memory.entries(x).ravel()):
            store(inner.code, buffer, k, number)
