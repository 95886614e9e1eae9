"""Systems with a triangular matrix: written out, or in a loop over rows."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...thresholds import THRESHOLDS
from .factorisations import of_batch, refuse_large


def triangular_solve(
    a: Array,
    b: Array,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    conjugate_a: bool,
    unit_diagonal: bool,
    **_: object,
) -> Any:
    """x with op(a) x = b, or x op(a) = b; the other half of a is not looked at."""
    refuse_large("triangular_solve", a.shape[-1])

    def solved(a: Array, b: Array) -> Any:
        a = a.conj() if conjugate_a else a
        # x a = b is aᵀ xᵀ = bᵀ.
        transposed = transpose_a == left_side
        a, b = (a.T if transposed else a), (b if left_side else b.T)
        forwards = lower != transposed
        if not forwards:
            a, b = a[::-1, ::-1], b[::-1]
        x = (_written_out if len(a) <= THRESHOLDS.triangle_written_out else _in_loop)(a, b, unit_diagonal)
        x = x if forwards else x[::-1]
        return x if left_side else x.T

    return of_batch(solved, a.ndim - 2)(a, b)


def _written_out(a: Array, b: Array, unit_diagonal: bool) -> Any:
    found: list[Any] = []
    for i in range(len(a)):
        rest = b[i]
        for j, x in enumerate(found):
            rest = rest - a[i, j] * x
        found.append(rest if unit_diagonal else rest / a[i, i])
    return jnp.stack(found) if found else b


def _in_loop(a: Array, b: Array, unit_diagonal: bool) -> Any:
    place = jnp.arange(len(a))

    def row(i: Array | int, x: Array) -> Any:
        # What is not known yet is 0, also where the other half of a is not finite.
        rest = b[i] - jnp.where(place < i, a[i], 0) @ x
        return x.at[i].set(rest if unit_diagonal else rest / a[i, i])

    return jax.lax.fori_loop(0, len(a), row, jnp.zeros_like(b))
