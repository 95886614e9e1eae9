"""General square systems A x = b."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


# Above this LAPACK is faster, also counting that it keeps a loop from becoming one kernel.
LOOPED = 32


def solve(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """x with A x = b, by Gauss–Jordan elimination with partial pivoting in plain arithmetic; LAPACK above 32 unknowns.

    A singular A gives infinities or NaN. Derivatives in both modes are those of the linear system.
    """
    if a.shape[0] > LOOPED:
        return jnp.linalg.solve(a, b)

    def eliminated(matrix):
        return lambda _, right: _gauss_jordan(matrix, right)

    return lax.custom_linear_solve(lambda x: jnp.sum(a * x, 1), b, solve=eliminated(a), transpose_solve=eliminated(a.T))


def _gauss_jordan(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    n = a.shape[0]
    rows = jnp.arange(n)

    def eliminate(j, augmented):
        column = lax.dynamic_slice_in_dim(augmented, j, 1, 1)
        pivot = jnp.argmax(jnp.where(rows >= j, jnp.abs(column[:, 0]), -1))
        at_j, at_pivot = (rows == j)[:, None], (rows == pivot)[:, None]
        row_j = lax.dynamic_slice_in_dim(augmented, j, 1, 0)
        row_pivot = lax.dynamic_slice_in_dim(augmented, pivot, 1, 0)
        swapped = jnp.where(at_j, row_pivot, jnp.where(at_pivot, row_j, augmented))
        column = lax.dynamic_slice_in_dim(swapped, j, 1, 1)
        row = row_pivot / lax.dynamic_slice_in_dim(row_pivot, j, 1, 1)
        return jnp.where(at_j, row, swapped - column * row)

    augmented = lax.fori_loop(0, n, eliminate, jnp.concatenate([a, b[:, None]], 1))
    return augmented[:, n]
