"""Dependence rules of indexing: gather, scatter and dynamic slices.

Positions are found by indexing an array of positions. Where an index is not known, each start that it can have is tried
and the results are united; the entry then depends on the index as well.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compiler import gathered, windows
from ..compiler.types import Equation
from .cells import Cells, unless
from .sets import Ids, Sets


class Choices:
    """The positions that an index may mean, for each choice of the starts that are not known.

    A start takes all values for which its window lies inside. So an entry whose position is the same in the first choice and
    in the last has the same one in all.
    """

    def __init__(self, counts: tuple[int, ...], positions: Callable[[tuple[int, ...]], np.ndarray]) -> None:
        self._counts, self._positions = counts, positions

    def __len__(self) -> int:
        return math.prod(self._counts)

    def positions(self, k: int) -> np.ndarray:
        """Those of the choice of this number."""
        return self._positions(tuple(map(int, np.unravel_index(k % len(self), self._counts))))


SCATTERS = {
    "scatter": None,
    "scatter-add": np.add,
    "scatter-sub": np.subtract,
    "scatter-mul": np.multiply,
    "scatter-min": np.minimum,
    "scatter-max": np.maximum,
}


def gather(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """`operand[indices]`."""
    operand, indices = inputs
    p, aval = eqn.params, eqn.outvars[0].aval
    choices = _gathered(operand.shape, indices, p["dimension_numbers"], p["slice_sizes"], p["mode"])
    fill = p["fill_value"]
    if fill is None:
        fill = jnp.nan if jnp.issubdtype(aval.dtype, jnp.inexact) else 0
    selector = _per_window(indices, p["dimension_numbers"].offset_dims, aval.shape, sets)
    return [_read(operand, choices, selector, np.asarray(fill).astype(operand.value.dtype), sets)]


def scatter(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """`operand.at[indices].set(updates)` and its relatives `add`, `multiply`, `min`, `max`, `apply`."""
    operand, indices, updates = inputs
    numbers = eqn.params["dimension_numbers"]
    inverse, sizes = windows(operand.shape, updates.shape, numbers)
    choices = _gathered(operand.shape, indices, inverse, sizes, eqn.params["mode"])
    selector = _per_window(indices, numbers.update_window_dims, updates.shape, sets)
    if eqn.primitive.name == "scatter" and eqn.params["update_jaxpr"] is not None:
        # Of `apply(f)` the updates mean nothing: f takes what is there.
        before = _read(operand, choices, selector, operand.value.dtype.type(0), sets)
        updates = Cells(before.dependence, np.zeros_like(before.known), before.value)
    return [_write(operand, updates, choices, selector, SCATTERS[eqn.primitive.name], sets)]


def dynamic_slice(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """A slice of fixed size whose start is an operand."""
    operand, *starts = inputs
    choices = _sliced(operand.shape, starts, eqn.params["slice_sizes"])
    return [_read(operand, choices, _of_any(starts, sets), operand.value.dtype.type(0), sets)]


def dynamic_update_slice(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """An operand with a slice, whose start is an operand, replaced."""
    del eqn
    operand, updates, *starts = inputs
    choices = _sliced(operand.shape, starts, updates.shape)
    return [_write(operand, updates, choices, _of_any(starts, sets), None, sets)]


def _read(operand: Cells, choices: Choices, selector: Ids, fill: Any, sets: Sets) -> Cells:
    """The entries at the positions of each choice (−1: outside, where `fill` is read)."""
    first, last = choices.positions(0), choices.positions(-1)
    inside, fixed = first >= 0, first == last
    known = fixed & np.where(inside, _take(operand.known, first), True)
    dependence = unless(~inside, _take(operand.dependence, first))
    if len(choices) > 1 and operand.dependence.any():
        others = np.stack([choices.positions(k) for k in range(len(choices))])
        dependence = sets.over(unless(others < 0, _take(operand.dependence, others)), (0,))
    value = np.where(inside, _take(operand.value, first), fill)
    return Cells(unless(known, sets.union(dependence, unless(fixed, selector))), known, value)


def _write(
    operand: Cells, updates: Cells, choices: Choices, selector: Ids, combine: np.ufunc | None, sets: Sets
) -> Cells:
    """The operand with `updates` put at the positions of each choice (−1: dropped), or combined with what is there."""
    first, last = (choices.positions(k).reshape(-1) for k in (0, -1))
    fixed = first == last
    certain = np.flatnonzero(fixed & (first >= 0))
    target = first[certain]
    dependence, known = operand.dependence.reshape(-1).copy(), operand.known.reshape(-1).copy()
    value, new = np.array(operand.value).reshape(-1), updates.value.reshape(-1)[certain]
    if combine is None:
        dependence[target], known[target], value[target] = 0, True, new
    else:
        with np.errstate(all="ignore"):
            combine.at(value, target, new)
    dependence = sets.at(dependence, target, updates.dependence.reshape(-1)[certain])
    np.logical_and.at(known, target, updates.known.reshape(-1)[certain])
    if not fixed.all():
        possible = np.broadcast_to(sets.union(updates.dependence, selector), updates.shape).reshape(-1)[~fixed]
        spots = np.stack([choices.positions(k).reshape(-1)[~fixed] for k in range(len(choices))])
        which, inside = np.broadcast_to(np.arange(len(possible)), spots.shape), spots >= 0
        dependence = sets.at(dependence, spots[inside], possible[which[inside]])
        known[spots[inside]] = False
    return Cells(*(a.reshape(operand.shape) for a in (unless(known, dependence), known, value)))


def _take(array: np.ndarray, positions: np.ndarray) -> np.ndarray:
    flat = array.reshape(-1)
    return flat[positions] if flat.size else np.zeros(positions.shape, flat.dtype)


def _gathered(
    shape: tuple[int, ...],
    indices: Cells,
    numbers: jax.lax.GatherDimensionNumbers,
    slice_sizes: tuple[int, ...],
    mode: jax.lax.GatherScatterMode | str | None,
) -> Choices:
    """The positions that a gather reads."""
    places = np.arange(math.prod(shape)).reshape(shape)

    def positions(choice: tuple[int, ...]) -> np.ndarray:
        columns = [np.where(indices.known[..., k], indices.value[..., k], start) for k, start in enumerate(choice)]
        index = np.stack(columns, -1).astype(indices.value.dtype) if columns else indices.value
        return gathered(places, index, numbers, slice_sizes, mode)

    counts = [
        1 if indices.known[..., k].all() else shape[axis] - slice_sizes[axis] + 1
        for k, axis in enumerate(numbers.start_index_map)
    ]
    return Choices(tuple(counts), positions)


def _sliced(shape: tuple[int, ...], starts: list[Cells], sizes: tuple[int, ...]) -> Choices:
    """The positions in a dynamic slice."""
    places = np.arange(math.prod(shape)).reshape(shape)
    room = [extent - size for extent, size in zip(shape, sizes, strict=True)]

    def positions(choice: tuple[int, ...]) -> np.ndarray:
        lows = [
            min(max(int(start.value), 0), most) if start.known else low
            for start, most, low in zip(starts, room, choice, strict=True)
        ]
        return places[tuple(slice(low, low + size) for low, size in zip(lows, sizes, strict=True))]

    return Choices(tuple(1 if start.known else most + 1 for start, most in zip(starts, room, strict=True)), positions)


def _of_any(starts: list[Cells], sets: Sets) -> Ids:
    """What any of the numbers depends on."""
    return sets.over(np.array([start.dependence for start in starts], np.int64), (0,))


def _per_window(indices: Cells, window_axes: tuple[int, ...], shape: tuple[int, ...], sets: Sets) -> Ids:
    """The dependence of each index vector, on the entries of its window in an array of `shape`."""
    vectors = sets.over(indices.dependence, (indices.dependence.ndim - 1,))
    return np.broadcast_to(np.expand_dims(vectors, tuple(int(axis) for axis in window_axes)), shape)
