"""A jaxpr as one function in the machine's code: for one element, or for a batch whose elements are lanes of vectors."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from ..jaxprs import equations
from . import machine
from .control import KNOWN, Control
from .instructions import KINDS, Value, kind_of
from .memory import Buffer, Memory, View, row_major
from .primitives import LARGE, SMALL


# More instructions than these take longer to compile than they save.
LIMIT = 60_000
# Fewer vectors than these are not worth the 20 µs that it takes to start a thread.
VECTORS = 4


def hindrances(jaxpr: ClosedJaxpr) -> tuple[str, ...]:
    """The names of what keeps a function from being compiled here; empty if nothing does."""
    found, size = [], 0
    for eqn in equations(jaxpr):
        avals = [v.aval for v in (*eqn.invars, *eqn.outvars)]
        if eqn.effects or eqn.primitive.name not in KNOWN or not all(map(_has_kind, avals)):
            found.append(eqn.primitive.name)
        size += sum(a.size if a.size <= LARGE else 1 for a in avals[len(eqn.invars) :])
    if size > LIMIT or not machine.available():
        found.append("size")
    return tuple(dict.fromkeys(found))


def _has_kind(aval: Any) -> bool:
    dtype = getattr(aval, "dtype", None)
    return dtype == jax.dtypes.float0 or (dtype is not None and np.dtype(dtype).name in KINDS)


def written(jaxpr: ClosedJaxpr, batched: Sequence[bool] = ()) -> str:
    """The module whose function `{name}.kernel` computes the outputs from the inputs.

    With `batched` inputs the function is that of a batch: these inputs, and all outputs, have a leading axis of any
    length. Raises `NotEntryByEntry` for what cannot be written.
    """
    lanes = any(batched)
    code = Memory(machine.vector_size() if lanes else 1)
    code.block = "start"
    ins, outs = jaxpr.jaxpr.invars, jaxpr.jaxpr.outvars
    inputs = [(v.aval, Buffer(f"%arg{k}", kind_of(v.aval.dtype), False, False)) for k, v in enumerate(ins)]
    outputs = [(v.aval, Buffer(f"%result{k}", kind_of(v.aval.dtype), False)) for k, v in enumerate(outs)]
    if lanes:
        _batch(code, jaxpr, inputs, outputs, batched)
    else:
        _one(code, jaxpr, inputs, outputs, [0] * len(inputs), 0)
    found = [line for k in range(len(ins)) for line in machine.buffer("%args", k, f"arg{k}")]
    found += [line for k in range(len(outs)) for line in machine.buffer("%results", k, f"result{k}")]
    if code.heap:
        code.function("malloc", "ptr", "i64")
        code.function("free", "void", "ptr")
        found += [
            f"%heap.raw = call ptr @malloc(i64 {code.heap + 64})",
            "%heap.int = ptrtoint ptr %heap.raw to i64",
            "%heap.up = add i64 %heap.int, 63",
            "%heap.aligned = and i64 %heap.up, -64",
            "%heap = inttoptr i64 %heap.aligned to ptr",
        ]
        code.lines.append("call void @free(ptr %heap.raw)")
    body = [*found, *code.stack, "br label %start", "start:", *code.lines]
    functions = (
        machine.in_threads(body, list(batched).index(True), VECTORS * code.width) if lanes else machine.alone(body)
    )
    return "\n".join([*code.constants, *code.declared.values(), *functions])


def _one(
    code: Memory, jaxpr: ClosedJaxpr, inputs: Any, outputs: Any, rows: list[Any], row: Any, mask: Value | None = None
) -> None:
    args = []
    for (aval, buffer), at in zip(inputs, rows, strict=True):
        x = View(buffer, np.dtype(aval.dtype), aval.shape, row_major(aval.shape), code.times(at, aval.size))
        args.append(x if x.size > SMALL else code.entries(x))
    results = Control(code, LIMIT).run(jaxpr, args)
    code.mask = mask
    for (aval, buffer), x in zip(outputs, results, strict=True):
        place = code.times(row, aval.size)
        to = View(buffer, np.dtype(aval.dtype), aval.shape, row_major(aval.shape), place)
        if isinstance(x, View) and x.size > SMALL:
            code.assign(to, x)
            continue
        for index in np.ndindex(aval.shape):
            code.store(buffer, code.at(to, index), code.entry(x, index))
    code.mask = None


def _batch(code: Memory, jaxpr: ClosedJaxpr, inputs: Any, outputs: Any, batched: Sequence[bool]) -> None:
    """Vectors of lanes, one after another; the lanes that the last one has too many repeat the last element."""
    first, width = list(batched).index(True), code.width
    size, last = Value("%batch", "i64"), Value("%batch.last", "i64")
    code.stack += [
        f"%dims.at = getelementptr i8, ptr %arg{first}.buffer, i64 {machine.DIMENSIONS_OF_BUFFER}",
        "%dims = load ptr, ptr %dims.at",
        f"{size.name} = load i64, ptr %dims",
        f"{last.name} = sub i64 {size.name}, 1",
    ]
    lanes = Value("<" + ", ".join(f"i64 {k}" for k in range(width)) + ">", "i64", True)
    more, done = code.name(), code.name()
    code.jump("next")
    code.label("next")
    # Threads take vectors as they get on.
    taken = code.write("atomicrmw add ptr %taken, i64 1 monotonic", "i64", False)
    start = code.op("mul", "i64", taken, width)
    left = code.op("icmp slt", "i64", start, size, result="i1")
    code.lines.append(f"br i1 {left.name}, label %{more}, label %{done}")
    code.label(more)
    with code.scope():
        place = code.op("add", "i64", start, lanes)
        row = code.intrinsic("smin", "i64", place, last)
        inside = code.op("icmp sle", "i64", place, last, result="i1")
        _one(code, jaxpr, inputs, outputs, [row if b else 0 for b in batched], row, inside)
    code.jump("next")
    code.label(done)


def compiled(jaxpr: ClosedJaxpr, batched: Sequence[bool] = ()) -> Callable[..., list[Any]]:
    """The function as one that JAX calls; arguments and results as `written` has them."""
    name = machine.register(written(jaxpr, batched))
    first = list(batched).index(True) if any(batched) else None

    def call(*xs: Any) -> list[Any]:
        lead = () if first is None else (xs[first].shape[0],)
        structs = [jax.ShapeDtypeStruct((*lead, *v.aval.shape), v.aval.dtype) for v in jaxpr.jaxpr.outvars]
        return list(jax.ffi.ffi_call(name, structs)(*xs))

    return call
