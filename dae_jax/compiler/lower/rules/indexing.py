"""Rules of reading and writing at indices, also ones that are found at run time."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...jaxprs import movement
from ...jaxprs.gathers import gathered, of_writes, windows
from ...jaxprs.objects import are_known, as_indices, objects
from ...types import Equation, Params
from ..access import load, store
from ..arithmetic import combined, total
from ..arrays import Fused, Operand, View, shared
from ..blocks import for_each
from ..context import Context
from ..dtypes import ALL, BOOL, INTEGERS, NUMBERS, REALS
from ..indices import indices_of, offsets_of, window_start
from ..registry import rule
from ..values import Index, Number, Value


@rule("dynamic_slice", (ALL, INTEGERS), by_memory=True)
def dynamic_slice(context: Context, x: Operand, *starts: Operand, slice_sizes: Sequence[int]) -> Any:
    """A window: in memory a view."""
    if not context.large and all(are_known(context.entries(start)) for start in starts):
        return movement.dynamic_slice(context.eqn, *map(context.entries, (x, *starts)))
    x = context.view(x)
    offset = context.memory.at(x, window_start(context, starts, 1, x.shape, slice_sizes))
    return View(x.dtype, tuple(context.out.shape), x.buffer, x.strides, offset)


@rule("dynamic_update_slice", (ALL, ALL, INTEGERS), by_memory=True)
def dynamic_update_slice(context: Context, x: Operand, update: Operand, *starts: Operand) -> Any:
    """An array with a window replaced."""
    if not context.large and all(are_known(context.entries(start)) for start in starts):
        return movement.dynamic_update_slice(context.eqn, *map(context.entries, (x, update, *starts)))
    out, update, *places = _owned(context, x, update, *starts)
    first = window_start(context, places, 2, out.shape, update.shape)
    to = View(out.dtype, update.shape, out.buffer, out.strides, context.memory.at(out, first))
    context.memory.assign(to, update)
    return out


def _owned(context: Context, x: Operand, *others: Operand) -> list[Any]:
    """An array that is updated in place where nothing else reads it, and what it is updated with, which may be a piece of it."""
    apart = [context.memory.copied(y, y.dtype) if shared(x, y) else y for y in others]
    return [context.memory.own(x, context.dtypes[0]), *apart]


def _replaced(_: Context, __: Number, update: Number) -> Any:
    return update


def _added(context: Context, before: Number, update: Number) -> Any:
    return total(context.code, context.to, before, update)


def _combined(context: Context, before: Number, update: Number) -> Any:
    return combined(context.code, context.name.removeprefix("scatter-"), context.to, before, update)


def _without_function(eqn: Equation) -> str | None:
    """JAX calls `x.at[i].apply(f)` a scatter too, one whose updates mean nothing."""
    return None if eqn.params["update_jaxpr"] is None else "entries replaced by a function of them are not written"


@rule("scatter", (ALL, INTEGERS, ALL), by_memory=True, requires=_without_function)
def scatter(context: Context, x: Operand, indices: Operand, update: Operand, **_: object) -> Any:
    """An array with entries replaced."""
    return _scattered(context, x, indices, update, _replaced)


@rule("scatter-add", (NUMBERS | BOOL, INTEGERS, NUMBERS | BOOL), by_memory=True)
def scatter_add(context: Context, x: Operand, indices: Operand, update: Operand, **_: object) -> Any:
    """An array with something added to entries."""
    return _scattered(context, x, indices, update, _added)


@rule("scatter-sub scatter-mul", (NUMBERS, INTEGERS, NUMBERS), by_memory=True)
@rule("scatter-min scatter-max", (REALS | BOOL, INTEGERS, REALS | BOOL), by_memory=True)
def scatter_combined(context: Context, x: Operand, indices: Operand, update: Operand, **_: object) -> Any:
    """An array with entries less something, times something, or replaced by what is smaller or larger."""
    return _scattered(context, x, indices, update, _combined)


Combine = Callable[[Context, Any, Any], Any]


def _scattered(context: Context, x: Operand, indices: Operand, update: Operand, combine: Combine) -> Any:
    code, memory, p = context.code, context.memory, context.eqn.params
    if not context.large and are_known(context.entries(indices)):
        entries = [context.entries(y) for y in (x, indices, update)]
        return movement.scatter(context.eqn, entries[0], entries[1], entries[2], lambda a, b: combine(context, a, b))
    out, indices, update = _owned(context, x, indices, update)
    numbers, sizes = windows(out.shape, update.shape, p["dimension_numbers"])
    read = indices_of(context, indices, not isinstance(update, np.ndarray) and update.size > memory.few)
    place = offsets_of(context, out, read, numbers, sizes, of_writes(p["mode"]))

    def put(index: list[Index], x: Number) -> None:
        at, inside = place(index)
        if combine is not _replaced:
            x = combine(context, load(code, out.buffer, at), x)
        if inside is not None:
            x = code.select(inside, x, load(code, out.buffer, at), out.buffer.kind)
        store(code, out.buffer, at, x)

    few = update.size if isinstance(update, np.ndarray) else memory.few
    for_each(code, update.shape, lambda index: put(index, memory.entry(update, index)), few)
    return out


@rule("gather", (ALL, INTEGERS), by_memory=True)
def gather(context: Context, x: Operand, indices: Operand, **p: Any) -> Any:
    """Entries at indices; what is outside of the array is the fill value."""
    code, memory, out = context.code, context.memory, context.out
    known = isinstance(indices, np.ndarray) and are_known(indices)
    if not context.large and known:
        return movement.gather(context.eqn, context.entries(x), context.entries(indices))
    x, fill = context.view(x), movement.fill_of(p["fill_value"], context.to)
    if known:
        return _at_known_places(context, x, as_indices(context.entries(indices)), p, fill)
    looped = out.size > memory.few
    read = indices_of(context, indices, looped)
    place = offsets_of(context, x, read, p["dimension_numbers"], p["slice_sizes"], p["mode"])

    def entry(index: Sequence[Index]) -> Any:
        at, inside = place(index)
        number = load(code, x.buffer, at)
        return number if inside is None else code.select(inside, number, fill, x.buffer.kind)

    if looped:
        return memory.made(context.to, out.shape, entry)
    return objects([entry(list(i)) for i in np.ndindex(out.shape)], out.shape)


def _at_known_places(context: Context, x: View, indices: np.ndarray, p: Params, fill: Number) -> View | Fused:
    """A view where they are evenly spaced, else by a table."""
    code, shape = context.code, tuple(context.out.shape)
    order = gathered(np.arange(x.size).reshape(x.shape), indices, p["dimension_numbers"], p["slice_sizes"], p["mode"])
    inside = bool((order >= 0).all())
    places = np.stack(np.unravel_index(np.maximum(order, 0), x.shape), -1) @ np.array(x.strides, int)
    strides = _even(places)
    if inside and strides is not None:
        return View(x.dtype, shape, x.buffer, strides, code.plus(x.offset, int(places[(0,) * places.ndim])))
    # Along axes of even steps places are worked out: the last may be in vectors that lie together.
    steps = [_step(places, axis) if inside else None for axis in range(places.ndim)]
    own = tuple(slice(None) if step is None else slice(1) for step in steps)
    table = context.memory.constant_view(np.where(order >= 0, places, -1)[own])

    def read(index: Sequence[Index]) -> Any:
        if not any(isinstance(i, Value) for i in index):
            k: Any = tuple(index)
            return load(code, x.buffer, code.plus(x.offset, int(places[k]))) if order[k] >= 0 else fill
        place = context.memory.entry(table, [i if step is None else 0 for i, step in zip(index, steps, strict=True)])
        if inside:
            for i, step in zip(index, steps, strict=True):
                place = place if step is None else code.plus(place, code.times(i, step))
            return load(code, x.buffer, code.plus(x.offset, place))
        number = load(code, x.buffer, code.plus(x.offset, code.intrinsic("smax", "i64", place, 0)))
        return code.select(code.op("icmp sge", "i64", place, 0, result="i1"), number, fill, x.buffer.kind)

    return Fused(x.dtype, shape, read, x.buffers)


def _step(places: np.ndarray, axis: int) -> int | None:
    """From each place to the next along an axis, where that is the same everywhere."""
    steps = np.diff(places, axis=axis)
    if not steps.size:
        return 0
    first = int(steps[(0,) * steps.ndim])
    return first if (steps == first).all() else None


def _even(places: np.ndarray) -> tuple[int, ...] | None:
    """The strides of places that are evenly spaced."""
    origin, unit = places[(0,) * places.ndim], np.eye(places.ndim, dtype=int)
    strides = [int(places[tuple(unit[d])] - origin) if n > 1 else 0 for d, n in enumerate(places.shape)]
    even = np.array_equal(places, origin + np.tensordot(strides, np.indices(places.shape), 1))
    return tuple(strides) if even else None
