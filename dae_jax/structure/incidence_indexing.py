"""Dependence rules of indexing: gather, scatter and dynamic slices.

Positions are found by indexing an array of positions. Where an index is not known, each start that it can have is tried
and the results are united; the entry then depends on the index as well.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compiler import gathered, windows
from ..compiler.types import Equation
from .cells import Cells, as_sets, union, unless


SCATTERS = {
    "scatter": None,
    "scatter-add": np.add,
    "scatter-sub": np.subtract,
    "scatter-mul": np.multiply,
    "scatter-min": np.minimum,
    "scatter-max": np.maximum,
}


def gather(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """`operand[indices]`."""
    operand, indices = inputs
    p, aval = eqn.params, eqn.outvars[0].aval
    positions = list(_gathered(operand.shape, indices, p["dimension_numbers"], p["slice_sizes"], p["mode"]))
    fill = p["fill_value"]
    if fill is None:
        fill = jnp.nan if jnp.issubdtype(aval.dtype, jnp.inexact) else 0
    selector = _per_window(indices, p["dimension_numbers"].offset_dims, aval.shape)
    return [_read(operand, positions, selector, np.asarray(fill).astype(operand.value.dtype))]


def scatter(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """`operand.at[indices].set(updates)` and its relatives `add`, `multiply`, `min`, `max`."""
    operand, indices, updates = inputs
    numbers = eqn.params["dimension_numbers"]
    inverse, sizes = windows(operand.shape, updates.shape, numbers)
    positions = list(_gathered(operand.shape, indices, inverse, sizes, eqn.params["mode"]))
    selector = _per_window(indices, numbers.update_window_dims, updates.shape)
    return [_write(operand, updates, positions, selector, SCATTERS[eqn.primitive.name])]


def dynamic_slice(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """A slice of fixed size whose start is an operand."""
    operand, *starts = inputs
    positions = list(_sliced(operand.shape, starts, eqn.params["slice_sizes"]))
    selector = union(np.array([start.dependence[()] for start in starts], object), (0,))
    return [_read(operand, positions, selector, operand.value.dtype.type(0))]


def dynamic_update_slice(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """An operand with a slice, whose start is an operand, replaced."""
    del eqn
    operand, updates, *starts = inputs
    positions = list(_sliced(operand.shape, starts, updates.shape))
    selector = union(np.array([start.dependence[()] for start in starts], object), (0,))
    return [_write(operand, updates, positions, selector, None)]


def _read(operand: Cells, positions: list[np.ndarray], selector: Any, fill: Any) -> Cells:
    """The entries at `positions` (−1: outside, where `fill` is read), one array for each choice of unknown indices."""
    first = positions[0]
    inside = first >= 0
    fixed = np.logical_and.reduce([first == other for other in positions])
    known = fixed & np.where(inside, _take(operand.known, first), True)
    dependence = unless(~inside, _take(operand.dependence, first))
    for other in positions[1:]:
        dependence = dependence | unless(other < 0, _take(operand.dependence, other))
    value = np.where(inside, _take(operand.value, first), fill)
    return Cells(unless(known, dependence | unless(fixed, selector)), known, value)


def _write(
    operand: Cells, updates: Cells, positions: list[np.ndarray], selector: np.ndarray, combine: np.ufunc | None
) -> Cells:
    """The operand with `updates` put at `positions` (−1: dropped), or combined with what is there."""
    first = positions[0]
    fixed = np.logical_and.reduce([first == other for other in positions])
    sure, target = fixed & (first >= 0), first.reshape(-1)
    dependence, known = operand.dependence.reshape(-1).copy(), operand.known.reshape(-1).copy()
    value = np.array(operand.value).reshape(-1)
    certain = np.flatnonzero(sure)
    if combine is None:
        dependence[target[certain]], known[target[certain]] = 0, True
        value[target[certain]] = updates.value.reshape(-1)[certain]
    else:
        with np.errstate(all="ignore"):
            combine.at(value, target[certain], updates.value.reshape(-1)[certain])
    new, new_known = updates.dependence.reshape(-1), updates.known.reshape(-1)
    for entry in certain:
        dependence[target[entry]] |= new[entry]
        known[target[entry]] &= new_known[entry]
    possible = np.broadcast_to(as_sets(updates.dependence | selector), first.shape).reshape(-1)
    for entry in np.flatnonzero(~fixed):
        for spot in {int(other.reshape(-1)[entry]) for other in positions} - {-1}:
            dependence[spot] |= possible[entry]
            known[spot] = False
    dependence = unless(known, dependence)
    return Cells(*(a.reshape(operand.shape) for a in (dependence, known, value)))


def _take(array: np.ndarray, positions: np.ndarray) -> np.ndarray:
    flat = array.reshape(-1)
    return flat[positions] if flat.size else np.zeros(positions.shape, flat.dtype)


def _gathered(
    shape: tuple[int, ...],
    indices: Cells,
    numbers: jax.lax.GatherDimensionNumbers,
    slice_sizes: tuple[int, ...],
    mode: jax.lax.GatherScatterMode | str | None,
) -> Iterator[np.ndarray]:
    """The positions that a gather reads, for each choice of the indices that are not known; −1 outside."""
    places = np.arange(int(np.prod(shape)), dtype=int).reshape(shape)
    starts = [
        [None] if indices.known[..., k].all() else range(shape[axis] - slice_sizes[axis] + 1)
        for k, axis in enumerate(numbers.start_index_map)
    ]
    for choice in itertools.product(*starts):
        columns = [
            indices.value[..., k] if start is None else np.where(indices.known[..., k], indices.value[..., k], start)
            for k, start in enumerate(choice)
        ]
        index = np.stack(columns, -1).astype(indices.value.dtype) if columns else indices.value
        yield gathered(places, index, numbers, slice_sizes, mode)


def _sliced(shape: tuple[int, ...], starts: list[Cells], sizes: tuple[int, ...]) -> Iterator[np.ndarray]:
    """The positions in a dynamic slice, for each choice of the starts that are not known."""
    places = np.arange(int(np.prod(shape))).reshape(shape)
    choices = [
        [min(max(int(start.value), 0), extent - size)] if start.known else range(extent - size + 1)
        for start, extent, size in zip(starts, shape, sizes, strict=True)
    ]
    for choice in itertools.product(*choices):
        yield places[tuple(slice(low, low + size) for low, size in zip(choice, sizes, strict=True))]


def _per_window(indices: Cells, window_axes: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """The dependence of each index vector, on the entries of its window in an array of `shape`."""
    vectors = union(indices.dependence, (indices.dependence.ndim - 1,))
    return np.broadcast_to(np.expand_dims(vectors, tuple(int(axis) for axis in window_axes)), shape)
