"""LU of a sparse matrix whose pivots are known beforehand, as loops over the indices of its factors, in one kernel.

Row after row, in a vector of work: row i less L[i, k] times row k of U, for the k of L in their order.

Source: I. S. Duff, A. M. Erisman, J. K. Reid, *Direct Methods for Sparse Matrices*, 2nd ed., section 10.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Inexact, PyTree

from ..compiler import jit
from ..types import IntScalar
from .storage import magnitude
from .symbolic_lu import TOGETHER, SymbolicLU


class Factors(NamedTuple):
    """`lu`: the factors, with the inverse of each pivot in its place; `scale`: of the rows; the `largest` number
    of the factors, where that of each row of A is 1.
    """

    lu: Inexact[Array, " filled"]
    scale: Float[Array, " n"]
    largest: Float[Array, ""]


class _Partial(NamedTuple):
    """What is there while rows are eliminated: the factors, what is left of the row, and the largest number of the factors."""

    lu: Inexact[Array, " filled"]
    work: Inexact[Array, " n"]
    largest: Float[Array, ""]


@jit
def eliminated(a: Inexact[Array, " entries"], k: SymbolicLU) -> Factors:
    """The factors of the matrix with entries `a`."""
    n, real = k.rows.shape[0], jnp.finfo(a.dtype).dtype
    zero = jnp.zeros((), real)

    def row(i: IntScalar, carry: tuple[_Partial, Array]) -> Any:
        (lu, work, largest), scales = carry
        begin, end = _get(k.given_start, i), _get(k.given_start, i + 1)
        size = lax.fori_loop(begin, end, lambda p, s: jnp.maximum(s, magnitude(_get(a, _get(k.given, p)))), zero)
        scale = 1 / jnp.where(size > 0, size, 1)
        spread = lambda p, work: _set(work, _get(k.given_at, p), scale * _get(a, _get(k.given, p)))
        found = _Partial(lu, lax.fori_loop(begin, end, spread, work), largest)
        begin, end = _get(k.group_start, i), _get(k.group_start, i + 1)
        found = lax.fori_loop(begin, end, lambda g, found: _less_group(k, g, found), found)
        middle = _get(k.diagonal, i)
        lu, work, largest = lax.fori_loop(middle, _get(k.start, i + 1), lambda q, found: _kept(k, q, found), found)
        return _Partial(_set(lu, middle, 1 / _get(lu, middle)), work, largest), _set(scales, i, scale)

    nothing = _Partial(jnp.zeros(k.at.shape, a.dtype), jnp.zeros(n, a.dtype), zero)
    (lu, _, largest), scale = _for_each_row(n, row, (nothing, jnp.zeros(n, real)))
    return Factors(lu, scale, largest)


def _less_group(k: SymbolicLU, g: IntScalar, found: _Partial) -> Any:
    """What is left of a row less the rows of U of a group of entries of L."""
    p, together = _get(k.group, g), _get(k.is_many, g)
    # Loops of one turn or none: what a branch gives would be copied.
    found = lax.fori_loop(jnp.uint32(0), together, lambda _, found: _less_many(k, p, found), found)
    return lax.fori_loop(together, jnp.uint32(1), lambda _, found: _less_one(k, p, found), found)


def _less_one(k: SymbolicLU, p: IntScalar, found: _Partial) -> _Partial:
    lu, work, largest = found
    column = _get(k.at, p)
    pivot = _get(k.diagonal, column)
    factor = _get(work, column) * _get(lu, pivot)
    subtract = lambda q, work: _add(work, _get(k.at, q), -factor * _get(lu, q))
    work = _set(work, column, jnp.zeros_like(factor))
    work = lax.fori_loop(pivot + 1, _get(k.start, column + 1), subtract, work)
    return _Partial(_set(lu, p, factor), work, jnp.maximum(largest, magnitude(factor)))


def _less_many(k: SymbolicLU, p: IntScalar, found: _Partial) -> _Partial:
    lu, work, largest = found
    column = _get(k.at, p)
    pivots = [_get(k.diagonal, column + j) for j in range(TOGETHER)]
    factors: list[Any] = []
    for j, pivot in enumerate(pivots):
        # In the row of U of pivot i the column of pivot j is j − i places after it.
        others: Any = sum(f * _get(lu, pivots[i] + (j - i)) for i, f in enumerate(factors))
        factors.append((_get(work, column + j) - others) * _get(lu, pivot))
    # What follows the columns of these pivots, of each row.
    places = [pivot + (TOGETHER - j) for j, pivot in enumerate(pivots)]

    def subtract(q: IntScalar, work: Array) -> Array:
        terms: Any = sum(f * _get(lu, place + (q - places[-1])) for f, place in zip(factors, places, strict=True))
        return _add(work, _get(k.at, q), -terms)

    for j, factor in enumerate(factors):
        work, lu = _set(work, column + j, jnp.zeros_like(factor)), _set(lu, p + j, factor)
        largest = jnp.maximum(largest, magnitude(factor))
    return _Partial(lu, lax.fori_loop(places[-1], _get(k.start, column + TOGETHER), subtract, work), largest)


def _kept(k: SymbolicLU, q: IntScalar, found: _Partial) -> _Partial:
    """What is left of a row at an entry of U goes there."""
    lu, work, largest = found
    value = _get(work, _get(k.at, q))
    lu, work = _set(lu, q, value), _set(work, _get(k.at, q), jnp.zeros_like(value))
    return _Partial(lu, work, jnp.maximum(largest, magnitude(value)))


@jit
def solved(factors: Factors, b: Inexact[Array, " n"], k: SymbolicLU) -> Inexact[Array, " n"]:
    """x with A x = b."""
    lu, n = factors.lu, k.rows.shape[0]
    less = lambda p, carry: (carry[0] - _get(lu, p) * _get(carry[1], _get(k.at, p)), carry[1])

    def forward(i: IntScalar, x: Array) -> Array:
        right = _get(factors.scale, i) * _get(b, _get(k.rows, i))
        return _set(x, i, lax.fori_loop(_get(k.start, i), _get(k.diagonal, i), less, (right, x))[0])

    def backward(i: IntScalar, carry: Any) -> Any:
        x, out = carry
        i = n - 1 - i
        middle = _get(k.diagonal, i)
        rest, _ = lax.fori_loop(middle + 1, _get(k.start, i + 1), less, (_get(x, i), x))
        value = rest * _get(lu, middle)
        return _set(x, i, value), _set(out, _get(k.columns, i), value)

    nothing = jnp.zeros(n, jnp.result_type(lu, b))
    x = _for_each_row(n, forward, nothing)
    return _for_each_row(n, backward, (x, nothing))[1]


@jit
def solved_transposed(factors: Factors, b: Inexact[Array, " n"], k: SymbolicLU) -> Inexact[Array, " n"]:
    """x with Aᵀ x = b."""
    lu, n = factors.lu, k.rows.shape[0]

    def spread(x: Array, value: Array, begin: IntScalar, end: IntScalar) -> Array:
        return lax.fori_loop(begin, end, lambda p, x: _add(x, _get(k.at, p), -value * _get(lu, p)), x)

    def forward(i: IntScalar, x: Array) -> Array:
        middle = _get(k.diagonal, i)
        value = _get(x, i) * _get(lu, middle)
        return spread(_set(x, i, value), value, middle + 1, _get(k.start, i + 1))

    def backward(i: IntScalar, carry: Any) -> Any:
        x, out = carry
        i = n - 1 - i
        value = _get(x, i)
        return spread(x, value, _get(k.start, i), _get(k.diagonal, i)), _set(
            out, _get(k.rows, i), value * _get(factors.scale, i)
        )

    nothing = jnp.zeros(n, jnp.result_type(lu, b))
    x = _for_each_row(n, lambda i, x: _set(x, i, _get(b, _get(k.columns, i)).astype(x.dtype)), nothing)
    x = _for_each_row(n, forward, x)
    return _for_each_row(n, backward, (x, nothing))[1]


def _for_each_row(n: int, step: Callable[[IntScalar, PyTree], PyTree], begin: PyTree) -> PyTree:
    return lax.fori_loop(jnp.uint32(0), jnp.uint32(n), step, begin)


# Every index is in bounds, and none is negative, so that there is nothing to count from the end: checks would take half of the time.


def _get(x: PyTree, i: IntScalar) -> Any:
    return x.at[i].get(mode="promise_in_bounds")


def _set(x: Array, i: Any, value: Array) -> Array:
    return x.at[i].set(value, mode="promise_in_bounds")


def _add(x: Array, i: Any, value: Array) -> Array:
    return x.at[i].add(value, mode="promise_in_bounds")
