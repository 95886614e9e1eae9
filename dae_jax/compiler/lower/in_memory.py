"""Primitives of JAX on large arrays."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..jaxprs.scalar_interpreter import ELEMENTWISE, Unsupported, is_number, objects
from .arrays import SMALL, Fused, View
from .indices import MOVED, Places
from .instructions import Complex, Value, kind_of, parts, parts_of


LARGE = 512
FOLDS = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
    "reduce_or": "or",
}  # fmt: skip
MORE_ELEMENTWISE = frozenset("shift_left shift_right_logical shift_right_arithmetic conj real imag complex".split())


class InMemory(Places):
    """Writes loops over the entries of large arrays."""

    def combined(self, name: str, dtype: Any, a: Any, b: Any) -> Any:
        """Two entries of a type by `add`, `mul`, `max`, `min`, `and` or `or`."""
        if is_number(a) and is_number(b):
            with np.errstate(all="ignore"):
                return _FOLDED[name](a, b)
        if isinstance(a, Complex) or isinstance(b, Complex):
            kind = next(p.kind for x in (a, b) for p in parts(x) if isinstance(p, Value))
            return self.code.of_complex(name, (a, b), kind)
        return self.code.arithmetic(name, dtype, a, b)

    def in_memory(self, eqn: Any, args: list[Any]) -> list[Any]:
        name, out = eqn.primitive.name, eqn.outvars[0].aval
        dtypes = [v.aval.dtype for v in eqn.invars]
        if name in MOVED:
            x = args[0] if isinstance(args[0], Fused) else self.code.memory(args[0], dtypes[0])
            return [self.moved(eqn, x, args)]
        if name in ("dynamic_update_slice", "scatter", "scatter-add"):
            return [self.update(eqn, args)]
        if name == "gather":
            return [self.taken(eqn, args)]
        if name in ELEMENTWISE or name in MORE_ELEMENTWISE or name == "add_any":
            one = (lambda x: self.total(*x)) if name == "add_any" else functools.partial(self.scalar, eqn)
            return [self._entry_by_entry(out, one, [self._operand(*a, out) for a in zip(args, dtypes, strict=True)])]
        if name == "iota":
            dimension, to = eqn.params["dimension"], np.dtype(out.dtype)
            number = lambda i: self.code.convert(np.int64(i) if isinstance(i, int) else i, np.dtype("int64"), to)
            return [Fused(to, out.shape, lambda index: number(index[dimension]), ())]
        args = [
            self.code.memory(a, d) if isinstance(a, np.ndarray) and a.ndim else a
            for a, d in zip(args, dtypes, strict=True)
        ]
        if name in FOLDS:
            return [self._fold_in_memory(eqn, args[0])]
        if name in ("argmax", "argmin"):
            return [self._extreme_in_memory(eqn, args[0])]
        if name in ("concatenate", "stack"):
            return [self._joined(out, args, eqn.params.get("dimension", eqn.params.get("axis")), name == "stack")]
        if name in ("split", "unstack"):
            return list(self.pieces(eqn, args[0]))
        if name == "dot_general":
            return [self._product(eqn, *map(self.code.memory, args, dtypes))]
        if name == "pad":
            return [self._padded(eqn, *args)]
        raise Unsupported(f"{name} of a large array")

    def _operand(self, x: Any, dtype: Any, out: Any) -> Any:
        """An operand of the result's shape, or with axes of length 1 whose one entry is read at any index."""
        if x.size == 1:
            return self.code.entries(x).reshape(())
        if isinstance(x, Fused) and x.shape == tuple(out.shape):
            return x
        x = self.code.memory(x, dtype)
        strides = tuple(0 if n == 1 else s for n, s in zip(x.shape, x.strides, strict=True))
        return x if x.contiguous and x.shape == tuple(out.shape) else dataclasses.replace(x, strides=strides)

    def _entry_by_entry(self, out: Any, one: Any, args: list[Any]) -> Fused:
        readers = [((lambda _, a=a: a[()]) if isinstance(a, np.ndarray) else self.code.flat(a)) for a in args]
        flat = [read for read in readers if read]
        return Fused(
            np.dtype(out.dtype),
            tuple(out.shape),
            lambda index: one([self.code.entry(a, index if a.ndim else []) for a in args]),
            tuple(b for a in args if not isinstance(a, np.ndarray) for b in a.buffers),
            (lambda place: one([read(place) for read in flat])) if len(flat) == len(args) else None,
            1 + max((getattr(a, "depth", 0) for a in args), default=0),
        )

    def _fold_in_memory(self, eqn: Any, x: View | Fused) -> Any:
        code, axes, out = self.code, eqn.params["axes"], eqn.outvars[0].aval
        name, dtype = FOLDS[eqn.primitive.name], np.dtype(out.dtype)
        kept = [d for d in range(x.ndim) if d not in axes]
        extents = [x.shape[d] for d in axes]
        first, flat = identity(name, dtype), code.flat(x)

        def entry(at: Sequence[Any], of: Sequence[Any]) -> Any:
            index: list[Any] = [None] * x.ndim
            for d, i in (*zip(kept, at, strict=True), *zip(axes, of, strict=True)):
                index[d] = i
            return code.entry(x, index)

        if math.prod(extents) <= SMALL:
            combine = functools.partial(self.combined, name, dtype)
            read = lambda at: in_pairs(combine, [entry(at, of) for of in np.ndindex(*extents)] or [first])
            return Fused(dtype, tuple(out.shape), read, x.buffers, depth=getattr(x, "depth", 0) + 1)
        if not kept and flat:
            return objects([self._total(name, dtype, [x.size], first, lambda i: flat(i[0]))], ())
        if not kept or max(kept) < max(axes):
            read = lambda at: self._total(name, dtype, extents, first, functools.partial(entry, at))
            return objects([read([])], ()) if not kept else code.made(dtype, out.shape, read)
        x = code.memory(x, dtype)
        result = code.made(dtype, out.shape, lambda _: first)

        def add(index: list[Any]) -> None:
            place = code.at(result, [index[d] for d in kept])
            found = self.combined(name, dtype, code.load(result.buffer, place), code.entry(x, index))
            code.store(result.buffer, place, found)

        with code.unmasked():
            code.for_each(x.shape, add)
        return result

    def _total(
        self, name: str, dtype: np.dtype, shape: Sequence[int], first: Any, entry: Callable[[list[Any]], Any]
    ) -> Any:
        """Entries combined by a loop, in any order."""
        code, (kind, count) = self.code, parts_of(dtype)
        if count == 2 and name != "add":
            raise Unsupported(f"{name} of many complex numbers")

        def step(found: list[Any], index: list[Any]) -> list[Any]:
            if name == "add" and dtype.kind in "fc":
                terms = parts(entry(index)) if count == 2 else (entry(index),)
                return [code.op("fadd reassoc contract", kind, a, b) for a, b in zip(found, terms, strict=True)]
            return [code.arithmetic(name, dtype, found[0], entry(index))]

        total = code.accumulated(shape, parts(first)[:count], [kind] * count, step)
        return Complex(*total) if count == 2 else total[0]

    def _extreme_in_memory(self, eqn: Any, x: View | Fused) -> Any:
        """`argmax` and `argmin`."""
        code, (axis,), out = self.code, eqn.params["axes"], eqn.outvars[0].aval
        kinds, place = [kind_of(x.dtype), kind_of(out.dtype)], np.dtype("int64")

        def read(at: Sequence[Any]) -> Any:
            entry = lambda i: code.entry(x, [*at[:axis], i, *at[axis:]])

            def step(found: list[Any], index: list[Any]) -> tuple[Any, Any]:
                number = code.convert(index[0], place, np.dtype(out.dtype))
                return self.better(eqn, found, (entry(index[0]), number))

            return code.accumulated([x.shape[axis]], (entry(0), out.dtype.type(0)), kinds, step)[1]

        return (
            code.made(out.dtype, out.shape, read)
            if out.size > code.few
            else Fused(np.dtype(out.dtype), out.shape, read, x.buffers)
        )

    def better(self, eqn: Any, found: Sequence[Any], other: Sequence[Any]) -> tuple[Any, Any]:
        """Of two numbers with their places the one that `argmax` or `argmin` looks for; the first that is undefined."""
        code, dtype = self.code, np.dtype(eqn.invars[0].aval.dtype)
        kind, (best, place), (y, there) = kind_of(dtype), found, other
        wins = code.compare("gt" if eqn.primitive.name == "argmax" else "lt", dtype, y, best)
        if dtype.kind == "f":
            undefined = code.op("fcmp uno", kind, y, y, result="i1")
            known = code.op("fcmp ord", kind, best, best, result="i1")
            wins = code.op("and", "i1", known, code.op("or", "i1", undefined, wins))
        return code.select(wins, y, best, kind), code.select(wins, there, place, kind_of(eqn.params["index_dtype"]))

    def _joined(self, out: Any, args: list[Any], axis: int, along_new: bool) -> View:
        """The arrays one after another along an axis, or along a new one."""
        result, start = self.code.new(out.dtype, out.shape), 0
        strides = tuple(s for d, s in enumerate(result.strides) if d != axis or not along_new)
        for x in args:
            part = View(result.dtype, x.shape, result.buffer, strides, start * result.strides[axis])
            self.code.assign(part, x, fresh=True)
            start += 1 if along_new else x.shape[axis]
        return result

    def _padded(self, eqn: Any, x: View | Fused, fill: Any) -> View:
        code, config, out = self.code, eqn.params["padding_config"], eqn.outvars[0].aval
        if any(low < 0 or high < 0 for low, high, _ in config):
            raise Unsupported("negative padding of a large array")
        value = code.entry(fill, [])
        result = code.made(out.dtype, out.shape, lambda _: value)
        offset = sum(low * s for (low, _, _), s in zip(config, result.strides, strict=True))
        strides = tuple((gap + 1) * s for (_, _, gap), s in zip(config, result.strides, strict=True))
        code.assign(View(result.dtype, x.shape, result.buffer, strides, offset), x, fresh=True)
        return result

    def _product(self, eqn: Any, a: View, b: View) -> View:
        """A product of matrices, summed over the contracted indices in turn."""
        code, out = self.code, eqn.outvars[0].aval
        (of_a, of_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
        free_a = [d for d in range(a.ndim) if d not in (*of_a, *batch_a)]
        free_b = [d for d in range(b.ndim) if d not in (*of_b, *batch_b)]
        n, m = len(batch_a), len(free_a)
        extents, dtype = [a.shape[d] for d in of_a], np.dtype(out.dtype)
        zero, number = dtype.type(0), lambda x, of: self.code.convert(x, of.dtype, dtype)

        def term(index: Sequence[Any], inner: Sequence[Any]) -> Any:
            i: list[Any] = [0] * a.ndim
            j: list[Any] = [0] * b.ndim
            for dims, values in ((batch_a, index[:n]), (free_a, index[n : n + m]), (of_a, inner)):
                for d, value in zip(dims, values, strict=True):
                    i[d] = value
            for dims, values in ((batch_b, index[:n]), (free_b, index[n + m :]), (of_b, inner)):
                for d, value in zip(dims, values, strict=True):
                    j[d] = value
            return self.combined("mul", dtype, number(code.entry(a, i), a), number(code.entry(b, j), b))

        if math.prod(extents) <= SMALL:
            plus = functools.partial(self.combined, "add", dtype)
            entry = lambda index: in_pairs(plus, [term(index, of) for of in np.ndindex(*extents)] or [zero])
        else:
            entry = lambda index: self._total("add", dtype, extents, zero, functools.partial(term, index))
        return code.made(out.dtype, out.shape, entry)


_FOLDED = {
    "add": np.add, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "and": np.bitwise_and,
    "or": np.bitwise_or,
}  # fmt: skip


def identity(name: str, dtype: np.dtype) -> Any:
    """The number that changes nothing."""
    if name in ("add", "or"):
        return dtype.type(0)
    if name in ("mul", "and"):
        return dtype.type(1) if name == "mul" else ~dtype.type(0)
    if dtype.kind == "b":
        return dtype.type(name == "min")
    if dtype.kind == "f":
        return dtype.type(-np.inf if name == "max" else np.inf)
    info = np.iinfo(dtype)
    return dtype.type(info.min if name == "max" else info.max)


def in_pairs(combine: Callable[[Any, Any], Any], terms: list[Any]) -> Any:
    """All terms combined, two by two: none waits for the sum of all before it, and less is rounded off."""
    while len(terms) > 1:
        rest = terms[len(terms) // 2 * 2 :]
        terms = [combine(a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)] + rest
    return terms[0]
