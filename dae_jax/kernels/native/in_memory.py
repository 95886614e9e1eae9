"""Primitives of JAX on arrays in memory, and at places found at run time."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..entries import ELEMENTWISE, EntryByEntry, NotEntryByEntry, is_number, objects
from ..gathers import windows
from .instructions import Complex, Value
from .memory import Memory, View, row_major


# More entries than these are kept in memory where a loop carries them, and where an operation makes them.
SMALL = 24
LARGE = 512

_MOVED = frozenset(
    "broadcast_in_dim copy copy_p dynamic_slice expand_dims reshape rev slice squeeze stop_gradient transpose".split()
)
FOLDS = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
    "reduce_or": "or",
}  # fmt: skip
MORE_ELEMENTWISE = frozenset("shift_left shift_right_logical shift_right_arithmetic conj real imag complex".split())


class InMemory(EntryByEntry):
    """Writes loops over the entries of large arrays."""

    def __init__(self, code: Memory, limit: int) -> None:
        super().__init__(limit)
        self.code = code

    def combined(self, name: str, a: Any, b: Any) -> Any:
        if isinstance(a, Complex) or isinstance(b, Complex) or np.iscomplexobj(a) or np.iscomplexobj(b):
            raise NotEntryByEntry(f"{name} of complex numbers")
        if is_number(a) and is_number(b):
            return _FOLDED[name](a, b)
        return self.code.arithmetic(name, _dtype(a if isinstance(a, Value) else b), a, b)

    def in_memory(self, eqn: Any, args: list[Any]) -> list[Any]:
        name, out = eqn.primitive.name, eqn.outvars[0].aval
        dtypes = [v.aval.dtype for v in eqn.invars]
        if name in _MOVED:
            return [self.moved(eqn, self.code.memory(args[0], dtypes[0]), args)]
        if name in ("dynamic_update_slice", "scatter", "scatter-add"):
            return [self._update(eqn, args)]
        if name == "gather":
            return [self._gather(eqn, args)]
        args = [self._readable(a, d) for a, d in zip(args, dtypes, strict=True)]
        if name in ELEMENTWISE or name in MORE_ELEMENTWISE or name == "add_any":
            args = [_repeated(a) for a in args]
            read = lambda index: [self.code.entry(a, index if a.ndim else []) for a in args]
            one = (lambda x: self.total(*x)) if name == "add_any" else functools.partial(self.scalar, eqn)
            return [self.code.made(out.dtype, out.shape, lambda index: one(read(index)))]
        if name in FOLDS:
            return [self._fold_in_memory(eqn, args[0])]
        if name == "concatenate":
            return [self._joined(out, args, eqn.params["dimension"])]
        if name == "iota":
            dimension, to = eqn.params["dimension"], np.dtype(out.dtype)
            number = lambda i: to.type(i) if isinstance(i, int) else self.code.convert(i, np.dtype("int64"), to)
            return [self.code.made(out.dtype, out.shape, lambda index: number(index[dimension]))]
        if name == "split":
            return self._split(eqn, args[0])
        if name == "dot_general":
            return [self._product(eqn, *args)]
        if name == "pad":
            return [self._padded(eqn, *args)]
        raise NotEntryByEntry(f"{name} of a large array")

    def _readable(self, x: Any, dtype: Any) -> Any:
        """An array that can be read at any index."""
        if isinstance(x, np.ndarray) and x.size > 1:
            return self.code.memory(x, dtype)
        return self.code.memory(x, dtype) if isinstance(x, np.ndarray) and x.ndim else x

    def moved(self, eqn: Any, x: View, args: list[Any]) -> View:
        """A view of the same buffer."""
        name, p = eqn.primitive.name, eqn.params
        shape = tuple(eqn.outvars[0].aval.shape)
        strides, offset = x.strides, x.offset
        match name:
            case "reshape" | "squeeze" | "expand_dims":
                x = x if x.contiguous else self.code.copied(x, x.dtype)
                strides, offset = row_major(shape), x.offset
            case "broadcast_in_dim":
                of = {
                    d: (0 if n == 1 else s)
                    for d, n, s in zip(p["broadcast_dimensions"], x.shape, x.strides, strict=True)
                }
                strides = tuple(of.get(d, 0) for d in range(len(shape)))
            case "transpose":
                strides = tuple(x.strides[d] for d in p["permutation"])
            case "rev":
                for d in p["dimensions"]:
                    offset = self.code.plus(offset, x.strides[d] * (x.shape[d] - 1))
                strides = tuple(-s if d in p["dimensions"] else s for d, s in enumerate(x.strides))
            case "slice":
                offset = self.code.plus(offset, sum(map(int.__mul__, p["start_indices"], x.strides)))
                strides = tuple(map(int.__mul__, p["strides"] or (1,) * x.ndim, x.strides))
            case "dynamic_slice":
                first = self._starts(args[1:], eqn.invars[1:], x.shape, p["slice_sizes"])
                offset = self.code.at(x, first)
        return View(x.buffer, x.dtype, shape, strides, offset)

    def _starts(self, starts: list[Any], of: list[Any], shape: Any, sizes: Any) -> list[Any]:
        """Where a window starts: moved inside the array."""
        code, out = self.code, []
        for start, v, n, size in zip(starts, of, shape, sizes, strict=True):
            i = self.code.entries(start)[()]
            if is_number(i):
                out.append(min(max(int(i), 0), n - size))
            elif n == size:
                out.append(0)
            else:
                i = code.convert(i, np.dtype(v.aval.dtype), np.dtype("int64"))
                out.append(code.intrinsic("smax", "i64", code.intrinsic("smin", "i64", i, n - size), 0))
        return out

    def own(self, x: Any, dtype: Any) -> View:
        """The array if nothing else refers to it, else a copy."""
        if isinstance(x, View) and x.buffer.writable and not x.buffer.references and x.whole:
            return x
        return self.code.copied(x, dtype)

    def _update(self, eqn: Any, args: list[Any]) -> View:
        code, dtype = self.code, eqn.invars[0].aval.dtype
        out = self.own(args[0], dtype)
        if eqn.primitive.name == "dynamic_update_slice":
            update, of = args[1], eqn.invars[2:]
            first = self._starts(args[2:], of, out.shape, update.shape)
            place = lambda index: (code.at(out, list(map(code.plus, first, index))), None)
        else:
            update, p = args[2], eqn.params
            numbers, sizes = windows(out.shape, update.shape, p["dimension_numbers"])
            indices = self._indices(eqn, args[1], isinstance(update, View) and update.size > SMALL)
            place = self._places(out, indices, numbers, sizes, p["mode"])

        def put(index: list[Any], x: Any) -> None:
            at, inside = place(index)
            if eqn.primitive.name == "scatter-add":
                x = self.combined("add", code.load(out.buffer, at), x)
            if inside is not None:
                x = code.select(inside, x, code.load(out.buffer, at), out.buffer.kind)
            code.store(out.buffer, at, x)

        self._for_each(update, put)
        return out

    def _for_each(self, x: Any, action: Callable[[list[Any], Any], None]) -> None:
        """Does something with each index and entry of an array; written out if they are few."""
        if isinstance(x, np.ndarray) or x.size <= SMALL:
            for index in np.ndindex(x.shape):
                action(list(index), self.code.entry(x, index))
            return
        with self.code.each(x.shape) as index:
            action(index, self.code.entry(x, index))

    def _indices(self, eqn: Any, indices: Any, looped: bool) -> Callable[[list[Any]], Any]:
        """The indices of a gather or scatter as integers of 64 bits."""
        dtype = np.dtype(eqn.invars[1].aval.dtype)
        indices = self.code.memory(indices, dtype) if looped else self.code.entries(indices)

        def read(index: list[Any]) -> Any:
            i = self.code.entry(indices, index)
            return int(i) if is_number(i) else self.code.convert(i, dtype, np.dtype("int64"))

        return read

    def _places(
        self, x: View, read: Callable[[list[Any]], Any], numbers: Any, sizes: Any, mode: Any
    ) -> Callable[[list[Any]], tuple[Any, Any]]:
        """Where in `x` an entry of a gather's result is, and whether it is inside (`None`: in any case)."""
        code = self.code
        dropped = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
        kept = [d for d in range(x.ndim) if d not in dropped]
        checked = jax.lax.GatherScatterMode.from_any(mode) is jax.lax.GatherScatterMode.FILL_OR_DROP

        def place(index: list[Any]) -> tuple[Any, Any]:
            batch = [i for d, i in enumerate(index) if d not in numbers.offset_dims]
            window = dict(zip(kept, (index[d] for d in numbers.offset_dims), strict=True))
            found, inside = [window.get(d, 0) for d in range(x.ndim)], None
            for d, of_batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
                found[d] = batch[of_batch]
            for k, d in enumerate(numbers.start_index_map):
                last, start = x.shape[d] - sizes[d], read([*batch, k])
                if isinstance(start, int):
                    clipped = min(max(start, 0), last)
                    fits: Any = np.bool_(clipped == start)
                else:
                    clipped = code.intrinsic("smax", "i64", code.intrinsic("smin", "i64", start, last), 0)
                    fits = code.op("icmp eq", "i64", clipped, start, result="i1")
                found[d] = code.plus(clipped, found[d])
                if checked and not (is_number(fits) and fits):
                    inside = fits if inside is None else code.op("and", "i1", inside, fits)
            return code.at(x, found), inside

        return place

    def _gather(self, eqn: Any, args: list[Any]) -> Any:
        code, p, out = self.code, eqn.params, eqn.outvars[0].aval
        x = code.memory(args[0], eqn.invars[0].aval.dtype)
        place = self._places(
            x, self._indices(eqn, args[1], out.size > SMALL), p["dimension_numbers"], p["slice_sizes"], p["mode"]
        )
        dtype = np.dtype(out.dtype)
        fill = p["fill_value"]
        fill = _fill(dtype) if fill is None else fill

        def read(index: list[Any]) -> Any:
            at, inside = place(index)
            number = code.load(x.buffer, at)
            return number if inside is None else code.select(inside, number, dtype.type(fill), x.buffer.kind)

        if out.size > SMALL:
            return code.made(dtype, out.shape, read)
        return objects([read(list(i)) for i in np.ndindex(out.shape)], out.shape)

    def _fold_in_memory(self, eqn: Any, x: Any) -> View:
        code, axes, out = self.code, eqn.params["axes"], eqn.outvars[0].aval
        name = FOLDS[eqn.primitive.name]
        result = code.new(out.dtype, out.shape)
        first = identity(name, np.dtype(out.dtype))
        kept = [d for d in range(x.ndim) if d not in axes]
        with code.unmasked():
            with code.each(out.shape) as index:
                code.store(result.buffer, code.at(result, index), first)
            with code.each(x.shape) as index:
                at = code.at(result, [index[d] for d in kept])
                total = code.arithmetic(name, out.dtype, code.load(result.buffer, at), code.entry(x, index))
                code.store(result.buffer, at, total)
        return result

    def _joined(self, out: Any, args: list[Any], dimension: int) -> View:
        code = self.code
        result, start = code.new(out.dtype, out.shape), 0
        with code.unmasked():
            for x in args:
                part = View(result.buffer, result.dtype, x.shape, result.strides, start * result.strides[dimension])
                code.assign(part, x)
                start += x.shape[dimension]
        return result

    def _split(self, eqn: Any, x: View) -> list[View]:
        axis, start, out = eqn.params["axis"], 0, []
        for v in eqn.outvars:
            offset = self.code.plus(x.offset, start * x.strides[axis])
            out.append(View(x.buffer, x.dtype, v.aval.shape, x.strides, offset))
            start += v.aval.shape[axis]
        return out

    def _padded(self, eqn: Any, x: View, fill: Any) -> View:
        code, config, out = self.code, eqn.params["padding_config"], eqn.outvars[0].aval
        if any(low < 0 or high < 0 for low, high, _ in config):
            raise NotEntryByEntry("negative padding of a large array")
        value = code.entry(fill, [])
        result = code.made(out.dtype, out.shape, lambda _: value)
        offset = sum(low * s for (low, _, _), s in zip(config, result.strides, strict=True))
        strides = tuple((gap + 1) * s for (_, _, gap), s in zip(config, result.strides, strict=True))
        with code.unmasked():
            code.assign(View(result.buffer, result.dtype, x.shape, strides, offset), x)
        return result

    def _product(self, eqn: Any, a: View, b: View) -> View:
        """A product of matrices, summed over the contracted indices in turn."""
        code, out = self.code, eqn.outvars[0].aval
        (of_a, of_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
        free_a = [d for d in range(a.ndim) if d not in (*of_a, *batch_a)]
        free_b = [d for d in range(b.ndim) if d not in (*of_b, *batch_b)]
        result = code.made(out.dtype, out.shape, lambda _: np.dtype(out.dtype).type(0))
        n, m = len(batch_a), len(free_a)
        with code.unmasked(), code.each(out.shape) as index, code.each([a.shape[d] for d in of_a]) as inner:
            i: list[Any] = [0] * a.ndim
            j: list[Any] = [0] * b.ndim
            for dims, values in ((batch_a, index[:n]), (free_a, index[n : n + m]), (of_a, inner)):
                for d, value in zip(dims, values, strict=True):
                    i[d] = value
            for dims, values in ((batch_b, index[:n]), (free_b, index[n + m :]), (of_b, inner)):
                for d, value in zip(dims, values, strict=True):
                    j[d] = value
            at = code.at(result, index)
            term = self.combined("mul", code.entry(a, i), code.entry(b, j))
            code.store(result.buffer, at, self.combined("add", code.load(result.buffer, at), term))
        return result


_FOLDED = {
    "add": np.add, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "and": np.bitwise_and,
    "or": np.bitwise_or,
}  # fmt: skip


def _fill(dtype: np.dtype) -> Any:
    """What a gather gives outside of the array."""
    if dtype.kind == "f":
        return np.nan
    if dtype.kind == "b":
        return True
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max


def _repeated(x: Any) -> Any:
    """An array that gives its one entry at any index along an axis of length 1."""
    if isinstance(x, np.ndarray):
        return x
    return dataclasses.replace(x, strides=tuple(0 if n == 1 else s for n, s in zip(x.shape, x.strides, strict=True)))


def identity(name: str, dtype: np.dtype) -> Any:
    """The number that changes nothing."""
    if name in ("add", "or"):
        return dtype.type(0)
    if name in ("mul", "and"):
        return dtype.type(1) if name == "mul" or dtype.kind == "b" else dtype.type(-1)
    if dtype.kind == "f":
        return dtype.type(-np.inf if name == "max" else np.inf)
    info = np.iinfo(dtype)
    return dtype.type(info.min if name == "max" else info.max)


_DTYPES = {"double": "float64", "float": "float32", "i1": "bool", "i32": "int32", "i64": "int64"}


def _dtype(x: Value) -> np.dtype:
    """The type of what is added up: floats, truth values and signed integers."""
    if x.kind not in _DTYPES:
        raise NotEntryByEntry(x.kind)
    return np.dtype(_DTYPES[x.kind])
