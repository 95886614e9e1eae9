"""Arrays in memory: data movement, also to places found at run time."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from ..jaxprs.gathers import gathered, windows
from ..jaxprs.scalar_interpreter import ScalarInterpreter, as_indices, is_number, objects
from .arrays import Fused, View, row_major, shared
from .instructions import Value
from .memory import Memory


MOVED = frozenset("broadcast_in_dim dynamic_slice expand_dims reshape rev slice squeeze transpose".split())


class Places(ScalarInterpreter):
    """Writes what moves the entries of large arrays."""

    def __init__(self, code: Memory, limit: int) -> None:
        super().__init__(limit)
        self.code = code

    def moved(self, eqn: Any, x: View | Fused, args: list[Any]) -> View | Fused:
        """A view of the same buffer, or the same entries yet to be computed."""
        name, p = eqn.primitive.name, eqn.params
        shape = tuple(eqn.outvars[0].aval.shape)
        if isinstance(x, Fused):
            found = self._deferred(name, p, x, shape)
            if found is not None:
                return found
            x = self.code.copied(x, x.dtype)
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
        return View(x.dtype, shape, x.buffer, strides, offset)

    def _deferred(self, name: str, p: Any, x: Fused, shape: tuple[int, ...]) -> Fused | None:
        code = self.code
        if name == "slice":
            starts, steps = p["start_indices"], p["strides"] or (1,) * x.ndim
            read = lambda index: x.read(
                [code.plus(s, code.times(i, k)) for s, i, k in zip(starts, index, steps, strict=True)]
            )
            return x.moved(shape, read)
        if name == "transpose":
            order = np.argsort(p["permutation"])
            return x.moved(shape, lambda index: x.read([index[d] for d in order]))
        flat = code.flat(x)
        if (
            name in ("reshape", "squeeze", "expand_dims", "broadcast_in_dim")
            and flat
            and shape
            and _in_order(p, x, shape)
        ):
            place = lambda index: functools.reduce(code.plus, map(code.times, index, row_major(shape)))
            return x.moved(shape, lambda index: flat(place(index)), flat)
        return None

    def pieces(self, eqn: Any, x: View | Fused) -> list[View | Fused]:
        """Pieces of an array along an axis, or its entries there."""
        axis, start, out = eqn.params["axis"], 0, []
        entries = eqn.primitive.name == "unstack"
        for v in eqn.outvars:
            shape, after = v.aval.shape, [start * (d == axis) for d in range(x.ndim)]
            if isinstance(x, View):
                strides = tuple(s for d, s in enumerate(x.strides) if d != axis or not entries)
                out.append(View(x.dtype, shape, x.buffer, strides, self.code.at(x, after)))
            else:
                whole = (lambda index: [*index[:axis], 0, *index[axis:]]) if entries else list
                read = lambda index, after=after, whole=whole: x.read(list(map(self.code.plus, whole(index), after)))
                out.append(x.moved(shape, read))
            start += 1 if entries else shape[axis]
        return out

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
                i = self._index(i, np.dtype(v.aval.dtype))
                out.append(code.intrinsic("smax", "i64", code.intrinsic("smin", "i64", i, n - size), 0))
        return out

    def own(self, x: Any, dtype: Any) -> View:
        """The array if nothing else refers to it, else a copy."""
        copies = self.code.always_copies
        if isinstance(x, View) and x.buffer.writable and not x.buffer.references and x.whole and not copies:
            return x
        return self.code.copied(x, dtype)

    def update(self, eqn: Any, args: list[Any]) -> View:
        """`dynamic_update_slice` and scatters, in place where nothing else reads the array."""
        code, dtype = self.code, eqn.invars[0].aval.dtype
        # The update may be a piece of the array that it changes.
        args = [args[0], *(code.copied(x, x.dtype) if shared(args[0], x) else x for x in args[1:])]
        out = self.own(args[0], dtype)
        if eqn.primitive.name == "dynamic_update_slice":
            update, of = args[1], eqn.invars[2:]
            first = self._starts(args[2:], of, out.shape, update.shape)
            code.assign(View(out.dtype, update.shape, out.buffer, out.strides, code.at(out, first)), update)
            return out
        update, p = args[2], eqn.params
        numbers, sizes = windows(out.shape, update.shape, p["dimension_numbers"])
        indices = self._indices(eqn, args[1], not isinstance(update, np.ndarray) and update.size > code.few)
        place = self._places(out, indices, numbers, sizes, p["mode"])

        def put(index: list[Any], x: Any) -> None:
            at, inside = place(index)
            if eqn.primitive.name == "scatter-add":
                x = self.combined("add", dtype, code.load(out.buffer, at), x)
            if inside is not None:
                x = code.select(inside, x, code.load(out.buffer, at), out.buffer.kind)
            code.store(out.buffer, at, x)

        code.for_each(
            update.shape,
            lambda index: put(index, code.entry(update, index)),
            update.size if isinstance(update, np.ndarray) else code.few,
        )
        return out

    def _indices(self, eqn: Any, indices: Any, looped: bool) -> Callable[[list[Any]], Any]:
        """The indices of a gather or scatter as integers of 64 bits."""
        dtype = np.dtype(eqn.invars[1].aval.dtype)
        indices = self.code.memory(indices, dtype) if looped else self.code.entries(indices)

        def read(index: list[Any]) -> Any:
            i = self.code.entry(indices, index)
            return int(i) if is_number(i) else self._index(i, dtype)

        return read

    def _index(self, i: Value, dtype: np.dtype) -> Value:
        """As an integer of 64 bits; what is too large for one is the largest."""
        i = self.code.intrinsic("umin", "i64", i, np.iinfo(np.int64).max) if dtype == np.uint64 else i
        return self.code.convert(i, dtype, np.dtype("int64"))

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

    def taken(self, eqn: Any, args: list[Any]) -> Any:
        """`gather`."""
        code, p, out = self.code, eqn.params, eqn.outvars[0].aval
        x = code.memory(args[0], eqn.invars[0].aval.dtype)
        dtype = np.dtype(out.dtype)
        fill = dtype.type(_fill(dtype) if p["fill_value"] is None else p["fill_value"])
        if isinstance(args[1], np.ndarray) and all(map(is_number, args[1].ravel())):
            return self._gathered(x, as_indices(args[1]), p, out, fill)
        place = self._places(
            x, self._indices(eqn, args[1], out.size > code.few), p["dimension_numbers"], p["slice_sizes"], p["mode"]
        )

        def read(index: Sequence[Any]) -> Any:
            at, inside = place(index)
            number = code.load(x.buffer, at)
            return number if inside is None else code.select(inside, number, fill, x.buffer.kind)

        if out.size > code.few:
            return code.made(dtype, out.shape, read)
        return objects([read(list(i)) for i in np.ndindex(out.shape)], out.shape)

    def _gathered(self, x: View, indices: np.ndarray, p: Any, out: Any, fill: Any) -> View | Fused:
        """A gather from known places: a view where they are evenly spaced."""
        code = self.code
        order = gathered(
            np.arange(x.size).reshape(x.shape), indices, p["dimension_numbers"], p["slice_sizes"], p["mode"]
        )
        inside = bool((order >= 0).all())
        places = np.stack(np.unravel_index(np.maximum(order, 0), x.shape), -1) @ np.array(x.strides, int)
        origin = places[(0,) * places.ndim]
        strides = [
            int(places[tuple(np.eye(places.ndim, dtype=int)[d])] - origin) if n > 1 else 0
            for d, n in enumerate(out.shape)
        ]
        if inside and np.array_equal(places, origin + np.tensordot(strides, np.indices(out.shape), 1)):
            return View(x.dtype, out.shape, x.buffer, tuple(strides), code.plus(x.offset, int(origin)))
        table = code.constant_view(np.where(order >= 0, places, -1))

        def read(index: Sequence[Any]) -> Any:
            if not any(isinstance(i, Value) for i in index):
                k = tuple(index)
                return code.load(x.buffer, code.plus(x.offset, int(places[k]))) if order[k] >= 0 else fill
            place = code.entry(table, index)
            if inside:
                return code.load(x.buffer, code.plus(x.offset, place))
            number = code.load(x.buffer, code.plus(x.offset, code.intrinsic("smax", "i64", place, 0)))
            return code.select(code.op("icmp sge", "i64", place, 0, result="i1"), number, fill, x.buffer.kind)

        return Fused(x.dtype, out.shape, read, x.buffers)


def _in_order(p: Any, x: Fused, shape: tuple[int, ...]) -> bool:
    """Whether a result has the entries of x in their order, each of them once."""
    dimensions = p.get("broadcast_dimensions", ())
    return x.size == int(np.prod(shape)) and list(dimensions) == sorted(dimensions)


def _fill(dtype: np.dtype) -> Any:
    """What a gather gives outside of the array."""
    if dtype.kind in "fc":
        return np.nan
    if dtype.kind == "b":
        return True
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
