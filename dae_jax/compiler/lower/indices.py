"""Indices that are found at run time: where windows start, and where in an array a gather reads and a scatter writes."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from ..jaxprs.objects import is_number
from .arithmetic import convert
from .arrays import Operand, View
from .context import Context
from .instructions import Instructions
from .values import Index, Value


Read = Callable[[Sequence[Any]], Any]


def window_start(
    context: Context, starts: Sequence[Operand], first: int, shape: Sequence[int], sizes: Sequence[int]
) -> list[Any]:
    """Where a window starts, moved inside the array; `first`: which operand the first of the starts is."""
    code, out = context.code, []
    for k, (start, n, size) in enumerate(zip(starts, shape, sizes, strict=True), first):
        i = context.memory.number(start)
        if is_number(i):
            out.append(min(max(int(i), 0), n - size))
        elif n == size:
            out.append(0)
        else:
            i = _index(code, i, context.dtypes[k])
            out.append(code.intrinsic("smax", "i64", code.intrinsic("smin", "i64", i, n - size), 0))
    return out


def indices_of(context: Context, indices: Operand, looped: bool) -> Read:
    """The indices of a gather or scatter as integers of 64 bits."""
    memory, dtype = context.memory, context.dtypes[1]
    indices = memory.view(indices, dtype) if looped else memory.entries(indices)

    def read(index: Sequence[Index]) -> Any:
        i = memory.entry(indices, index)
        return int(i) if is_number(i) else _index(context.code, i, dtype)

    return read


def _index(code: Instructions, i: Value, dtype: np.dtype) -> Value:
    """As an integer of 64 bits; what is too large for one is the largest."""
    i = code.intrinsic("umin", "i64", i, np.iinfo(np.int64).max) if dtype == np.uint64 else i
    return convert(code, i, dtype, np.dtype("int64"))


def offsets_of(
    context: Context,
    x: View,
    read: Read,
    numbers: jax.lax.GatherDimensionNumbers,
    sizes: Sequence[int],
    mode: jax.lax.GatherScatterMode | str | None,
) -> Read:
    """Where in `x` an entry of a gather's result is, and whether it is inside (`None`: in any case)."""
    dropped = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = [d for d in range(x.ndim) if d not in dropped]
    checked = jax.lax.GatherScatterMode.from_any(mode) is jax.lax.GatherScatterMode.FILL_OR_DROP

    def place(index: Sequence[Index]) -> tuple[Any, Any]:
        batch = [i for d, i in enumerate(index) if d not in numbers.offset_dims]
        window = dict(zip(kept, (index[d] for d in numbers.offset_dims), strict=True))
        found, inside = [window.get(d, 0) for d in range(x.ndim)], None
        for d, of_batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            found[d] = batch[of_batch]
        for k, d in enumerate(numbers.start_index_map):
            clipped, fits = _clipped(context.code, read([*batch, k]), x.shape[d] - sizes[d])
            found[d] = context.code.plus(clipped, found[d])
            if checked and not (is_number(fits) and fits):
                inside = fits if inside is None else context.code.op("and", "i1", inside, fits)
        return context.memory.at(x, found), inside

    return place


def _clipped(code: Instructions, start: Index, last: int) -> tuple[Any, Any]:
    """A start moved inside the array, and whether it was there."""
    if isinstance(start, int):
        clipped = min(max(start, 0), last)
        return clipped, np.bool_(clipped == start)
    clipped = code.intrinsic("smax", "i64", code.intrinsic("smin", "i64", start, last), 0)
    return clipped, code.op("icmp eq", "i64", clipped, start, result="i1")
