"""Arrays of entries: numpy arrays of objects, each of them a number where that is known."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeGuard, overload

import numpy as np


if TYPE_CHECKING:
    from typing_extensions import TypeIs


def objects(entries: Sequence[object], shape: tuple[int, ...]) -> np.ndarray:
    """A list as an array of objects."""
    out = np.empty(len(entries), dtype=object)
    for i, entry in enumerate(entries):  # `out[:] = entries` would ask traced entries for their values
        out[i] = entry
    return out.reshape(shape)


@overload
def is_number(x: object) -> "TypeIs[np.number]": ...


@overload
def is_number(x: object, *which: float) -> "TypeGuard[np.number]": ...


def is_number(x: object, *which: float) -> bool:
    """Whether an entry is known while tracing, and one of `which` where these are given."""
    return isinstance(x, np.generic) and (not which or any(x == value for value in which))


def are_known(x: np.ndarray) -> bool:
    """Whether all entries are."""
    return all(map(is_number, x.ravel()))


def as_indices(x: np.ndarray) -> np.ndarray:
    """Known entries as integers of 64 bits; what is too large for one is the largest."""
    values = np.array(list(x.ravel())) if x.size else np.zeros(0, np.int64)
    if values.dtype == np.uint64:
        values = np.minimum(values, np.uint64(np.iinfo(np.int64).max))
    return values.astype(np.int64).reshape(x.shape)


def columns(x: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """An array with these axes as its first one."""
    x = np.moveaxis(x, axes, range(len(axes)))
    return x.reshape((math.prod(x.shape[: len(axes)]), *x.shape[len(axes) :]))
