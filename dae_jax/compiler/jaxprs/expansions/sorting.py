"""Sorting of short arrays: each entry's place is the number of those that come before it."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...thresholds import THRESHOLDS
from ...types import Arrays
from ..scalar_interpreter import Unsupported
from .factorisations import of_batch


def sort(*operands: Array, dimension: int, num_keys: int, **_: object) -> list[Any]:
    """The operands in the order of the first so many of them; equal entries stay in their order, NaN comes last."""
    n = operands[0].shape[dimension]
    if n > THRESHOLDS.longest_sort:
        raise Unsupported(f"sort of more than {THRESHOLDS.longest_sort} entries")
    if n < 2:
        return list(operands)
    last = [jnp.moveaxis(x, dimension, -1) for x in operands]

    def in_order(*xs: Array) -> list[Any]:
        place = _places([part for x in xs[:num_keys] for part in _parts(x)], n)
        return [jnp.zeros_like(x).at[place].set(x, unique_indices=True, mode="promise_in_bounds") for x in xs]

    return [jnp.moveaxis(x, -1, dimension) for x in of_batch(in_order, last[0].ndim - 1)(*last)]


def _parts(x: Array) -> list[Any]:
    return [x.real, x.imag] if jnp.iscomplexobj(x) else [x]


def _places(keys: Arrays, n: int) -> Any:
    index = jnp.arange(n)

    def place(i: Array | int) -> Any:
        before, equal = jnp.zeros(n, bool), jnp.ones(n, bool)
        for key in keys:
            here = key[i]
            before |= equal & _less(key, here)
            equal &= ~_less(key, here) & ~_less(here, key)
        return jnp.sum(before | (equal & (index < i)), dtype=jnp.int32)

    return jax.lax.fori_loop(0, n, lambda i, places: places.at[i].set(place(i)), jnp.zeros(n, jnp.int32))


def _less(a: Array, b: Array) -> Any:
    return (a < b) | (~jnp.isnan(a) & jnp.isnan(b)) if jnp.issubdtype(a.dtype, jnp.floating) else a < b
