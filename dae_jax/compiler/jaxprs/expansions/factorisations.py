"""LU with partial pivoting, and Cholesky, of small matrices: written out, or in a loop over columns."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ...thresholds import THRESHOLDS
from ...types import Equation
from ..scalar_interpreter import Unsupported


def refuse_large(name: str, *sizes: int) -> None:
    """Raises `Unsupported` for matrices that are LAPACK's, and for those without entries."""
    if not min(sizes):
        raise Unsupported(f"{name} of an empty matrix")
    if max(sizes) > THRESHOLDS.largest_matrix:
        raise Unsupported(f"{name} of more than {THRESHOLDS.largest_matrix} rows or columns")


def is_by_lapack(eqn: Equation) -> bool:
    """Whether a factorisation is one of a matrix that is too large to be written, for which there is a rule."""
    if eqn.primitive.name not in ("lu", "cholesky", "triangular_solve"):
        return False
    return max(eqn.invars[0].aval.shape[-2:]) > THRESHOLDS.largest_matrix and bool(eqn.outvars[0].aval.size)


def of_batch(fn: Callable[..., Any], batch: int) -> Callable[..., Any]:
    """`fn` for operands with so many leading axes."""
    for _ in range(batch):
        fn = jax.vmap(fn)
    return fn


def lu(a: Array, **_: object) -> tuple[Any, Any, Any]:
    """L and U in one matrix, the rows that were exchanged, and the permutation; as LAPACK's getrf.

    A column of zeros is no pivot and stays as it is.
    """
    m, n = a.shape[-2:]
    refuse_large("lu", m, n)
    return of_batch(_lu_written_out if max(m, n) <= THRESHOLDS.matrix_written_out else _lu_in_loop, a.ndim - 2)(a)


def _size(x: Array) -> Any:
    return jnp.abs(x.real) + jnp.abs(x.imag) if jnp.iscomplexobj(x) else jnp.abs(x)


def _lu_written_out(a: Array) -> tuple[Any, Any, Any]:
    m, n = a.shape
    rows = [[a[i, j] for j in range(n)] for i in range(m)]
    order: list[Any] = [jnp.int32(i) for i in range(m)]
    pivots = []
    for k in range(min(m, n)):
        largest, pivot = _size(rows[k][k]), jnp.int32(k)
        for i in range(k + 1, m):
            larger = _size(rows[i][k]) > largest
            largest = jnp.where(larger, _size(rows[i][k]), largest)
            pivot = jnp.where(larger, jnp.int32(i), pivot)
        pivots.append(pivot)
        for i in range(k + 1, m):
            swap = pivot == i
            top, row = [*rows[k], order[k]], [*rows[i], order[i]]
            *rows[k], order[k] = [jnp.where(swap, y, x) for x, y in zip(top, row, strict=True)]
            *rows[i], order[i] = [jnp.where(swap, x, y) for x, y in zip(top, row, strict=True)]
        by = jnp.where(_size(rows[k][k]) == 0, 1, rows[k][k])
        for i in range(k + 1, m):
            factor = rows[i][k] / by
            rows[i] = [
                *rows[i][:k],
                factor,
                *(x - factor * y for x, y in zip(rows[i][k + 1 :], rows[k][k + 1 :], strict=True)),
            ]
    return jnp.stack([jnp.stack(row) for row in rows]), jnp.stack(pivots), jnp.stack(order)


def _lu_in_loop(a: Array) -> tuple[Any, Any, Any]:
    m, n = a.shape
    row, column = jnp.arange(m), jnp.arange(n)

    def eliminate(k: Array | int, carry: tuple[Array, ...]) -> Any:
        a, pivots, order = carry
        sizes = _size(a[:, k])
        # What is not a number is a pivot only where it stands.
        sizes = jnp.where(jnp.isnan(sizes), jnp.where(row == k, jnp.inf, -1), sizes)
        pivot = jnp.argmax(jnp.where(row >= k, sizes, -1)).astype(jnp.int32)
        swapped = jnp.where(row == k, pivot, jnp.where(row == pivot, k, row))
        a, order = a[swapped], order[swapped]
        by = jnp.where(_size(a[k, k]) == 0, 1, a[k, k])
        factors = jnp.where(row > k, a[:, k] / by, 0)
        a = a - factors[:, None] * jnp.where(column > k, a[k], 0)
        a = jnp.where((column == k) & (row[:, None] > k), factors[:, None], a)
        return a, pivots.at[k].set(pivot), order

    start = (a, jnp.zeros(min(m, n), jnp.int32), jnp.arange(m, dtype=jnp.int32))
    return jax.lax.fori_loop(0, min(m, n), eliminate, start)


def lu_pivots_to_permutation(pivots: Array, *, permutation_size: int, **_: object) -> Any:
    """The order of the rows after the exchanges."""

    def permutation(pivots: Array) -> Any:
        places, first = jnp.arange(permutation_size), jnp.arange(permutation_size, dtype=jnp.int32)

        def written(order: Array, k: int) -> Array:
            j = pivots[k]
            return jnp.where(places == k, order[j], jnp.where(places == j, order[k], order))

        def in_place(k: Array | int, order: Array) -> Array:
            j = pivots[k]
            return order.at[k].set(order[j]).at[j].set(order[k])

        if permutation_size > THRESHOLDS.largest_matrix:
            return jax.lax.fori_loop(0, len(pivots), in_place, first)
        return functools.reduce(written, range(len(pivots)), first)

    return of_batch(permutation, pivots.ndim - 1)(pivots)


def cholesky(a: Array, **_: object) -> Any:
    """L with L Lᴴ = a, of its lower half; not a number where a is not positive definite."""
    refuse_large("cholesky", a.shape[-1])
    n = a.shape[-1]
    return of_batch(_cholesky_written_out if n <= THRESHOLDS.triangle_written_out else _cholesky_in_loop, a.ndim - 2)(a)


def _cholesky_written_out(a: Array) -> Any:
    n = len(a)
    zero = jnp.zeros((), a.dtype)
    found: list[list[Any]] = [[zero] * n for _ in range(n)]
    definite = jnp.bool_(True)
    for j in range(n):
        # As in LAPACK, what is not a number spoils what follows from it only.
        square = a[j, j].real - sum((_size_squared(x) for x in found[j][:j]), jnp.zeros((), a.real.dtype))
        definite &= ~(square <= 0)
        root = jnp.sqrt(square)
        found[j][j] = root.astype(a.dtype)
        for i in range(j + 1, n):
            rest = a[i, j] - sum((x * y.conj() for x, y in zip(found[i][:j], found[j][:j], strict=True)), zero)
            found[i][j] = rest / root
    return jnp.where(definite, jnp.stack([jnp.stack(row) for row in found]), jnp.nan)


def _size_squared(x: Array) -> Any:
    return x.real**2 + x.imag**2 if jnp.iscomplexobj(x) else x * x


def _cholesky_in_loop(a: Array) -> Any:
    n = len(a)
    row = jnp.arange(n)

    def column(j: Array | int, carry: Array) -> Any:
        found, definite = carry
        rest = a[:, j] - found @ found[j].conj()
        square = rest[j].real
        root = jnp.sqrt(square)
        column = jnp.where(row > j, rest / root, jnp.where(row == j, root.astype(a.dtype), 0))
        return found.at[:, j].set(column), definite & ~(square <= 0)

    found, definite = jax.lax.fori_loop(0, n, column, (jnp.zeros_like(a), jnp.bool_(True)))
    return jnp.where(definite, found, jnp.nan)
