"""A jaxpr as one function in the machine's code: for one element, or for a batch whose elements are lanes of vectors."""

import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from ..emit import available, register
from ..emit.interface import batch_size, buffer
from ..emit.runtime import alone, heap, in_threads
from ..emit.target import Target, host
from ..jaxprs.inline import inlined
from ..jaxprs.numbers import on_numbers
from ..jaxprs.scalar_interpreter import Unsupported
from ..jaxprs.walk import equations
from .arrays import SMALL, Buffer, View, row_major
from .control import KNOWN, Control
from .cost import extent
from .instructions import KINDS, Value, parts_of
from .lane_queue import LaneQueue, main_loop
from .memory import Memory


# More instructions than these take longer to compile than they save.
LIMIT = 60_000
# `extent` counts up to this many for each that is written: it knows of no zeros, and of nothing that is there twice.
AT_MOST = 4
# Bytes of memory that a function may take for its arrays, all lanes of a vector together.
HEAP = 2**30
# Loops over this many entries use the machine's longest vectors: a chain of 64 pendulums gains 15 %, arrays of ten lose 25 %.
LONG = 256


def hindrances(jaxpr: ClosedJaxpr) -> tuple[str, ...]:
    """The names of what keeps a function from being compiled here; empty if nothing does."""
    found = []
    for eqn in equations(jaxpr):
        avals = [v.aval for v in (*eqn.invars, *eqn.outvars)]
        if eqn.effects or not (eqn.primitive.name in KNOWN or _is_number(eqn)) or not all(map(_has_kind, avals)):
            found.append(eqn.primitive.name)
    arguments = [v.aval.size > SMALL for v in jaxpr.jaxpr.invars]
    if not found and (not available() or _is_too_large(jaxpr, extent(jaxpr, arguments)[0])):
        found.append("size")
    return tuple(dict.fromkeys(found))


def _is_too_large(jaxpr: ClosedJaxpr, estimate: int) -> bool:
    if not LIMIT < estimate <= AT_MOST * LIMIT:
        return estimate > LIMIT
    with contextlib.suppress(Unsupported):
        written(jaxpr, ())
        return False
    return True


def _is_number(eqn: Any) -> bool:
    """Whether an equation gives a number that is known already, as the factorials of Taylor arithmetic are."""
    if not all(isinstance(v, Literal) for v in eqn.invars):
        return False
    return on_numbers(eqn, [np.asarray(v.val, v.aval.dtype) for v in eqn.invars]) is not None


def _has_kind(aval: Any) -> bool:
    dtype = getattr(aval, "dtype", None)
    return dtype == jax.dtypes.float0 or (dtype is not None and np.dtype(dtype).name in KINDS)


def written(jaxpr: ClosedJaxpr, batched: tuple[bool, ...] = (), always_copies: bool = False) -> str:
    """The module whose function `{name}.kernel` computes the outputs from the inputs.

    With `batched` inputs the function is that of a batch: these inputs, and all outputs, have a leading axis of any
    length. `always_copies`: nothing is updated in place, and no memory used twice. Raises `Unsupported` for what cannot be written.
    """
    return _written(jaxpr, batched, always_copies, host())


@functools.lru_cache(maxsize=2)
def _written(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], always_copies: bool, target: Target) -> str:
    jaxpr = inlined(jaxpr)
    place = main_loop(jaxpr) if any(batched) else None
    if place is not None:
        with contextlib.suppress(Unsupported):
            return _Module(jaxpr, batched, always_copies, target.width).text(place)
    return _Module(jaxpr, batched, always_copies, target.width).text(None)


class _Module:
    def __init__(self, jaxpr: ClosedJaxpr, batched: Sequence[bool], always_copies: bool, width: int) -> None:
        self.jaxpr, self.batched = jaxpr, list(batched) or [False] * len(jaxpr.jaxpr.invars)
        self.code = Memory(width if any(batched) else 1, always_copies)
        self.run = Control(self.code, LIMIT)

    def text(self, place: int | None) -> str:
        """The module's text; `place`: where the main loop is, if lanes shall be refilled."""
        code, lanes = self.code, any(self.batched)
        ins, outs = self.jaxpr.jaxpr.invars, self.jaxpr.jaxpr.outvars
        code.block = "start"
        if lanes:
            self._batch(place)
        else:
            self._store(self.run.run(self.jaxpr, self._arguments(None)), None, None)
        found = [line for k in range(len(ins)) for line in buffer("%args", k, f"arg{k}")]
        found += [line for k in range(len(outs)) for line in buffer("%results", k, f"result{k}")]
        if code.heap > HEAP:
            raise Unsupported("arrays that are too large")
        if code.heap:
            code.function("malloc", "ptr", "i64")
            code.function("free", "void", "ptr")
            taken, given_back = heap(code.heap)
            found += taken
            code.lines += given_back
        body = [*found, *code.stack, "br label %start", "start:", *code.lines]
        functions = (
            in_threads(body, self._find_batch(), code.width) if lanes else alone(body, code.longest >= LONG)
        )
        return "\n".join([*code.constants, *code.declared.values(), *functions])

    def _find_batch(self) -> list[str]:
        first = self.batched.index(True)
        return [*buffer("%args", first, f"arg{first}"), *batch_size(f"arg{first}")]

    def _arguments(self, row: Value | None) -> list[Any]:
        """The arguments, of the element that each lane has."""
        args = []
        for k, (v, batched) in enumerate(zip(self.jaxpr.jaxpr.invars, self.batched, strict=True)):
            x = self._view(f"%arg{k}", v.aval, row if batched else None, writable=False)
            args.append(x if x.size > SMALL else self.code.entries(x))
        return args

    def _store(self, results: list[Any], row: Value | None, mask: Value | None) -> None:
        """Stores the results of the element that each lane has, in the lanes of the mask."""
        code = self.code
        before, code.mask = code.mask, mask
        for k, (v, x) in enumerate(zip(self.jaxpr.jaxpr.outvars, results, strict=True)):
            to = self._view(f"%result{k}", v.aval, row, writable=True)
            if not isinstance(x, np.ndarray) and x.size > SMALL:
                code.assign(to, x)
                continue
            for index in np.ndindex(v.aval.shape):
                code.store(to.buffer, code.at(to, index), code.entry(x, index))
        code.mask = before

    def _view(self, pointer: str, aval: Any, row: Value | None, writable: bool) -> View:
        kind, parts = parts_of(aval.dtype)
        buffer = Buffer(pointer, kind, False, writable, parts)
        place = 0 if row is None else self.code.times(row, aval.size)
        return View(np.dtype(aval.dtype), aval.shape, buffer, row_major(aval.shape), place)

    def _batch(self, place: int | None) -> None:
        """All elements that this thread gets: threads take them from a counter, as they get on."""
        code, width = self.code, self.code.width
        size, last = Value("%batch", "i64"), Value("%batch.last", "i64")
        code.stack += [
            *batch_size(f"arg{self.batched.index(True)}"),
            f"{last.name} = sub i64 {size.name}, 1",
        ]
        if place is not None:
            LaneQueue(code, self.run, self._arguments, self._store, size, last).write(self.jaxpr, place)
            return
        # A vector of elements at a time; the lanes that the last one has too many repeat the last element.
        lanes = Value("<" + ", ".join(f"i64 {k}" for k in range(width)) + ">", "i64", True)
        more, done = code.name(), code.name()
        code.jump("next")
        code.label("next")
        start = code.write(f"atomicrmw add ptr %taken, i64 {width} monotonic", "i64", False)
        left = code.op("icmp slt", "i64", start, size, result="i1")
        code.lines.append(f"br i1 {left.name}, label %{more}, label %{done}")
        code.label(more)
        with code.scope():
            element = code.op("add", "i64", start, lanes)
            row = code.intrinsic("smin", "i64", element, last)
            inside = code.op("icmp sle", "i64", element, last, result="i1")
            self._store(self.run.run(self.jaxpr, self._arguments(row)), row, inside)
        code.jump("next")
        code.label(done)


def compiled(
    jaxpr: ClosedJaxpr, batched: Sequence[bool] = (), always_copies: bool = False
) -> Callable[..., list[Any]]:
    """The function as one that JAX calls; arguments and results as `written` has them."""
    name = register(written(jaxpr, tuple(batched), always_copies), jaxpr)
    first = list(batched).index(True) if any(batched) else None

    def call(*xs: Any) -> list[Any]:
        lead = () if first is None else (xs[first].shape[0],)
        structs = [jax.ShapeDtypeStruct((*lead, *v.aval.shape), v.aval.dtype) for v in jaxpr.jaxpr.outvars]
        return list(jax.ffi.ffi_call(name, structs)(*xs))

    return call
