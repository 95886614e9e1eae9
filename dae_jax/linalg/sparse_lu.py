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
        begin, end = at(k.given_start, i), at(k.given_start, i + 1)
        size = lax.fori_loop(begin, end, lambda p, s: jnp.maximum(s, magnitude(at(a, at(k.given, p)))), zero)
        scale = 1 / jnp.where(size > 0, size, 1)
        spread = lambda p, work: replaced(work, at(k.given_at, p), scale * at(a, at(k.given, p)))
        found = _Partial(lu, lax.fori_loop(begin, end, spread, work), largest)
        begin, end = at(k.group_start, i), at(k.group_start, i + 1)
        found = lax.fori_loop(begin, end, lambda g, found: _less_group(k, g, found), found)
        middle = at(k.diagonal, i)
        lu, work, largest = lax.fori_loop(middle, at(k.start, i + 1), lambda q, found: _kept(k, q, found), found)
        return _Partial(replaced(lu, middle, 1 / at(lu, middle)), work, largest), replaced(scales, i, scale)

    nothing = _Partial(jnp.zeros(k.at.shape, a.dtype), jnp.zeros(n, a.dtype), zero)
    (lu, _, largest), scale = for_each_row(n, row, (nothing, jnp.zeros(n, real)))
    return Factors(lu, scale, largest)


def _less_group(k: SymbolicLU, g: IntScalar, found: _Partial) -> Any:
    """What is left of a row less the rows of U of a group of entries of L."""
    p, together = at(k.group, g), at(k.is_many, g)
    # Loops of one turn or none: what a branch gives would be copied.
    found = lax.fori_loop(jnp.uint32(0), together, lambda _, found: _less_many(k, p, found), found)
    return lax.fori_loop(together, jnp.uint32(1), lambda _, found: _less_one(k, p, found), found)


def _less_one(k: SymbolicLU, p: IntScalar, found: _Partial) -> _Partial:
    lu, work, largest = found
    column = at(k.at, p)
    pivot = at(k.diagonal, column)
    factor = at(work, column) * at(lu, pivot)
    subtract = lambda q, work: added(work, at(k.at, q), -factor * at(lu, q))
    work = replaced(work, column, jnp.zeros_like(factor))
    work = lax.fori_loop(pivot + 1, at(k.start, column + 1), subtract, work)
    return _Partial(replaced(lu, p, factor), work, jnp.maximum(largest, magnitude(factor)))


def _less_many(k: SymbolicLU, p: IntScalar, found: _Partial) -> _Partial:
    lu, work, largest = found
    column = at(k.at, p)
    pivots = [at(k.diagonal, column + j) for j in range(TOGETHER)]
    factors: list[Any] = []
    for j, pivot in enumerate(pivots):
        # In the row of U of pivot i the column of pivot j is j − i places after it.
        others: Any = sum(f * at(lu, pivots[i] + (j - i)) for i, f in enumerate(factors))
        factors.append((at(work, column + j) - others) * at(lu, pivot))
    # What follows the columns of these pivots, of each row.
    places = [pivot + (TOGETHER - j) for j, pivot in enumerate(pivots)]

    def subtract(q: IntScalar, work: Array) -> Array:
        terms: Any = sum(f * at(lu, place + (q - places[-1])) for f, place in zip(factors, places, strict=True))
        return added(work, at(k.at, q), -terms)

    for j, factor in enumerate(factors):
        work, lu = replaced(work, column + j, jnp.zeros_like(factor)), replaced(lu, p + j, factor)
        largest = jnp.maximum(largest, magnitude(factor))
    return _Partial(lu, lax.fori_loop(places[-1], at(k.start, column + TOGETHER), subtract, work), largest)


def _kept(k: SymbolicLU, q: IntScalar, found: _Partial) -> _Partial:
    """What is left of a row at an entry of U goes there."""
    lu, work, largest = found
    value = at(work, at(k.at, q))
    lu, work = replaced(lu, q, value), replaced(work, at(k.at, q), jnp.zeros_like(value))
    return _Partial(lu, work, jnp.maximum(largest, magnitude(value)))


@jit
def solved(factors: Factors, b: Inexact[Array, " n"], k: SymbolicLU) -> Inexact[Array, " n"]:
    """x with A x = b."""
    lu, n = factors.lu, k.rows.shape[0]
    less = lambda p, carry: (carry[0] - at(lu, p) * at(carry[1], at(k.at, p)), carry[1])

    def forward(i: IntScalar, x: Array) -> Array:
        right = at(factors.scale, i) * at(b, at(k.rows, i))
        return replaced(x, i, lax.fori_loop(at(k.start, i), at(k.diagonal, i), less, (right, x))[0])

    def backward(i: IntScalar, carry: Any) -> Any:
        x, out = carry
        i = n - 1 - i
        middle = at(k.diagonal, i)
        rest, _ = lax.fori_loop(middle + 1, at(k.start, i + 1), less, (at(x, i), x))
        value = rest * at(lu, middle)
        return replaced(x, i, value), replaced(out, at(k.columns, i), value)

    nothing = jnp.zeros(n, jnp.result_type(lu, b))
    x = for_each_row(n, forward, nothing)
    return for_each_row(n, backward, (x, nothing))[1]


@jit
def solved_transposed(factors: Factors, b: Inexact[Array, " n"], k: SymbolicLU) -> Inexact[Array, " n"]:
    """x with Aᵀ x = b."""
    lu, n = factors.lu, k.rows.shape[0]

    def spread(x: Array, value: Array, begin: IntScalar, end: IntScalar) -> Array:
        return lax.fori_loop(begin, end, lambda p, x: added(x, at(k.at, p), -value * at(lu, p)), x)

    def forward(i: IntScalar, x: Array) -> Array:
        middle = at(k.diagonal, i)
        value = at(x, i) * at(lu, middle)
        return spread(replaced(x, i, value), value, middle + 1, at(k.start, i + 1))

    def backward(i: IntScalar, carry: Any) -> Any:
        x, out = carry
        i = n - 1 - i
        value = at(x, i)
        return spread(x, value, at(k.start, i), at(k.diagonal, i)), replaced(
            out, at(k.rows, i), value * at(factors.scale, i)
        )

    nothing = jnp.zeros(n, jnp.result_type(lu, b))
    x = for_each_row(n, lambda i, x: replaced(x, i, at(b, at(k.columns, i)).astype(x.dtype)), nothing)
    x = for_each_row(n, forward, x)
    return for_each_row(n, backward, (x, nothing))[1]


def for_each_row(n: int, step: Callable[[IntScalar, PyTree], PyTree], begin: PyTree) -> PyTree:
    """Steps for n rows, one after the other."""
    return lax.fori_loop(jnp.uint32(0), jnp.uint32(n), step, begin)


# Every index is in bounds, and none is negative, so that there is nothing to count from the end: checks would take half of the time.


def at(x: PyTree, i: IntScalar) -> Any:
    """x[i]."""
    return x.at[i].get(mode="promise_in_bounds")


def replaced(x: Array, i: Any, value: Array) -> Array:
    """x with another entry i."""
    return x.at[i].set(value, mode="promise_in_bounds")


def added(x: Array, i: Any, value: Array) -> Array:
    """x with more at entry i."""
    return x.at[i].add(value, mode="promise_in_bounds")
