"""General square systems A x = b."""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Inexact

from ..types import IntScalar


# Up to UNROLLED unknowns the elimination is straight-line code (3 unknowns: 90 ns in place of 590); up to LOOPED a loop over
# columns; above, LAPACK is faster, also counting that it keeps a loop from becoming one kernel.
UNROLLED = 4
LOOPED = 32


def solve(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """x with A x = b, by elimination with partial pivoting in plain arithmetic; LAPACK above 32 unknowns.

    A singular A gives infinities or NaN. Derivatives in both modes are those of the linear system.
    """
    if a.shape[0] <= UNROLLED:
        return _unrolled(a, b)
    if a.shape[0] > LOOPED:
        return jnp.linalg.solve(a, b)

    def eliminated(matrix: Inexact[Array, "n n"]):
        return lambda _, right: _gauss_jordan(matrix, right)

    return lax.custom_linear_solve(lambda x: jnp.sum(a * x, 1), b, solve=eliminated(a), transpose_solve=eliminated(a.T))


def row_products(a: Float[Array, "m n"], b: Float[Array, "k n"]) -> Float[Array, "m k"]:
    """A Bᵀ, in plain arithmetic up to the size of the largest system that is solved so."""
    if len(a) * b.size > LOOPED**3:
        return jnp.dot(a, b.T, precision=lax.Precision.HIGHEST)
    return jnp.sum(a[:, None] * b, -1)


def determinant_sign(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """The sign of det A, 0 of a singular A."""
    return signed_log_determinant(a)[0]


def signed_log_determinant(a: Float[Array, "n n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The sign of det A, 0 of a singular A, and log |det A|, by elimination with partial pivoting in plain arithmetic; LAPACK above
    32 rows.
    """
    if len(a) > LOOPED:
        return tuple(jnp.linalg.slogdet(a))
    if len(a) == 1:
        return jnp.sign(a[0, 0]), jnp.log(jnp.abs(a[0, 0]))

    def eliminate(j: IntScalar, carry: Any) -> Any:
        a, sign, log = carry
        a, pivot = _eliminated(a, j)
        return jnp.where(pivot == 0, 0, a), sign * jnp.sign(pivot), log + jnp.log(jnp.abs(pivot))

    return lax.fori_loop(0, len(a), eliminate, (a, jnp.ones((), a.dtype), jnp.zeros((), a.dtype)))[1:]


def least_sign(a: Float[Array, "n n"], rank: int) -> Float[Array, ""]:
    """The least sign of so many pivots, the largest on the diagonal: −1 where A, near S, which is symmetric, positive semidefinite and of
    that rank, turns a direction of the range of S around, or several. Positive pivots come first: a row that has changed its sign alone,
    and that depends on others, has not turned that range.
    """
    if rank == len(a) <= 2:
        return jnp.sign(
            a[0, 0] if rank == 1 else jnp.minimum(a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0], jnp.maximum(a[0, 0], a[1, 1]))
        )

    def eliminate(_: IntScalar, carry: tuple[Float[Array, "n n"], Float[Array, ""]]):
        a, sign = carry
        diagonal = jnp.sum(a * jnp.eye(len(a), dtype=a.dtype), 1)
        here = jnp.arange(len(a)) == jnp.argmax(jnp.where(diagonal > 0, diagonal, -diagonal / 10))
        pivot = jnp.sum(jnp.where(here, diagonal, 0))
        row, column = (jnp.sum(jnp.where(x, a, 0), k, keepdims=True) for k, x in enumerate((here[:, None], here)))
        left = jnp.where(here | here[:, None], 0, a - column * row / jnp.where(pivot == 0, 1, pivot))
        return left, jnp.minimum(sign, jnp.sign(pivot))

    return lax.fori_loop(0, rank, eliminate, (a, jnp.ones((), a.dtype)))[1]


def _gauss_jordan(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    n = len(a)
    augmented = lax.fori_loop(0, n, lambda j, x: _eliminated(x, j)[0], jnp.concatenate([a, b[:, None]], 1))
    return augmented[:, n]


def _eliminated(a: Float[Array, "n k"], j: IntScalar) -> tuple[Float[Array, "n k"], Float[Array, ""]]:
    """A with column j eliminated by its largest element of the rows from j on, which is in row j then, and this pivot, with
    the other sign where two rows had to change places.
    """
    rows = jnp.arange(len(a))
    column = lax.dynamic_slice_in_dim(a, j, 1, 1)
    place = jnp.argmax(jnp.where(rows >= j, jnp.abs(column[:, 0]), -1))
    at_j, at_pivot = (rows == j)[:, None], (rows == place)[:, None]
    row_j = lax.dynamic_slice_in_dim(a, j, 1, 0)
    row_pivot = lax.dynamic_slice_in_dim(a, place, 1, 0)
    swapped = jnp.where(at_j, row_pivot, jnp.where(at_pivot, row_j, a))
    column = lax.dynamic_slice_in_dim(swapped, j, 1, 1)
    pivot = lax.dynamic_slice_in_dim(row_pivot, j, 1, 1)
    row = row_pivot / pivot
    return jnp.where(at_j, row, swapped - column * row), jnp.where(place == j, 1, -1) * pivot[0, 0]


def _unrolled(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    n = a.shape[0]
    rows = [[*(a[i, k] for k in range(n)), b[i]] for i in range(n)]
    for j in range(n):
        for i in range(j + 1, n):
            swap = jnp.abs(rows[i][j]) > jnp.abs(rows[j][j])
            rows[j], rows[i] = (
                [jnp.where(swap, y, x) for x, y in zip(first, second, strict=True)]
                for first, second in ((rows[j], rows[i]), (rows[i], rows[j]))
            )
        for i in range(j + 1, n):
            factor = rows[i][j] / rows[j][j]
            rows[i] = [x - factor * y if k > j else x for k, (x, y) in enumerate(zip(rows[i], rows[j], strict=True))]
    x: list[Array] = [b] * n
    for i in reversed(range(n)):
        x[i] = (rows[i][n] - sum(rows[i][k] * x[k] for k in range(i + 1, n))) / rows[i][i]
    return jnp.stack(x) if n else b
