"""Which entries a gather reads and a scatter writes, found without JAX: an operation on numbers would be compiled for each shape."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int


def gathered(
    places: Int[np.ndarray, "..."],
    indices: Int[np.ndarray, "..."],
    numbers: jax.lax.GatherDimensionNumbers,
    slice_sizes: Sequence[int],
    mode: jax.lax.GatherScatterMode | str | None,
) -> Int[np.ndarray, "..."]:
    """`jax.lax.gather(places, indices, numbers, slice_sizes, mode=mode, fill_value=-1)` on numbers."""
    shape, sizes = np.array(places.shape, int), np.array(slice_sizes, int)
    batch = indices.shape[:-1]
    starts = np.zeros((*batch, len(shape)), np.int64)
    starts[..., list(numbers.start_index_map)] = indices
    for axis, of_batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
        starts[..., axis] = np.indices(batch)[of_batch]
    inside = np.all((starts >= 0) & (starts <= shape - sizes), -1)
    starts = np.clip(starts, 0, shape - sizes)
    offsets = np.indices(slice_sizes).reshape(len(shape), math.prod(slice_sizes)).T
    found = places[tuple(np.moveaxis(starts[..., None, :] + offsets, -1, 0))]
    if jax.lax.GatherScatterMode.from_any(mode) is jax.lax.GatherScatterMode.FILL_OR_DROP:
        found = np.where(inside[..., None], found, -1)
    dropped = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = (size for axis, size in enumerate(slice_sizes) if axis not in dropped)
    found = found.reshape((*batch, *kept))
    window = range(len(batch), found.ndim)
    return np.moveaxis(found, tuple(window), numbers.offset_dims)


def scattered(
    places: Int[np.ndarray, "..."],
    indices: Int[np.ndarray, "..."],
    shape: tuple[int, ...],
    numbers: jax.lax.ScatterDimensionNumbers,
    mode: jax.lax.GatherScatterMode | str | None,
) -> Int[np.ndarray, "..."]:
    """Where `jax.lax.scatter` puts each of the updates, which have this shape; −1: nowhere."""
    return gathered(places, indices, *windows(places.shape, shape, numbers), of_writes(mode))


def of_writes(mode: jax.lax.GatherScatterMode | str | None) -> jax.lax.GatherScatterMode:
    """How a scatter takes indices that are outside: where they were promised not to be, too, XLA leaves out what is written to them,
    although it reads at the nearest ones.
    """
    modes = jax.lax.GatherScatterMode
    return modes.CLIP if modes.from_any(mode) is modes.CLIP else modes.FILL_OR_DROP


def windows(
    operand: tuple[int, ...], updates: tuple[int, ...], numbers: jax.lax.ScatterDimensionNumbers
) -> tuple[Any, tuple[int, ...]]:
    """The gather that reads what a scatter writes: its dimension numbers and slice sizes."""
    sizes = iter([updates[axis] for axis in numbers.update_window_dims])
    outside = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    inverse = jax.lax.GatherDimensionNumbers(
        offset_dims=tuple(numbers.update_window_dims),
        collapsed_slice_dims=tuple(numbers.inserted_window_dims),
        start_index_map=tuple(numbers.scatter_dims_to_operand_dims),
        operand_batching_dims=tuple(numbers.operand_batching_dims),
        start_indices_batching_dims=tuple(numbers.scatter_indices_batching_dims),
    )
    return inverse, tuple(1 if axis in outside else next(sizes) for axis in range(len(operand)))
