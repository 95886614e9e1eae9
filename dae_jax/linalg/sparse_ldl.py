"""S = Uᵀ D⁻¹ U of a sparse symmetric matrix along its diagonal, D that of U, as loops over the indices of U, in one kernel.

Row after row, in a vector of work: row k is that of S less U[i, k] / D[i] times row i of U from column k on, for each i < k.

Source: I. S. Duff, A. M. Erisman, J. K. Reid, *Direct Methods for Sparse Matrices*, 2nd ed., section 10.
"""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..compiler import jit
from ..types import IntScalar
from .sparse_lu import added, at, for_each_row, replaced
from .symbolic_ldl import TOGETHER, SymbolicLDL


@jit
def eliminated(entries: Float[Array, " entries"], k: SymbolicLDL) -> Float[Array, " filled"]:
    """U of the matrix with these entries, with the inverse of each pivot in its place."""
    entries = jnp.append(entries, 0)

    def row(j: IntScalar, carry: Any) -> Any:
        u, work = carry
        begin, end = at(k.start, j), at(k.start, j + 1)
        spread = lambda q, work: replaced(work, at(k.at, q), at(entries, at(k.given, q)))
        work = lax.fori_loop(begin, end, spread, work)
        one = lambda g, work: _less(k, at(k.alone_row, g), at(k.alone, g), 1, u, work)
        many = lambda g, work: _less(k, at(k.many_row, g), at(k.many, g), TOGETHER, u, work)
        work = lax.fori_loop(at(k.alone_start, j), at(k.alone_start, j + 1), one, work)
        work = lax.fori_loop(at(k.many_start, j), at(k.many_start, j + 1), many, work)
        u = lax.fori_loop(begin, end, lambda q, u: replaced(u, q, at(work, at(k.at, q))), u)
        return replaced(u, begin, 1 / at(u, begin)), work

    nothing = jnp.zeros(k.at.shape, entries.dtype), jnp.zeros(k.order.shape, entries.dtype)
    return for_each_row(len(k.order), row, nothing)[0]


def _less(k: SymbolicLDL, row: IntScalar, place: IntScalar, count: int, u: Array, work: Array) -> Any:
    """What is left of a row less what so many rows from `row` on, of one pattern, have from its column on, that of `place`."""
    begin = [at(k.start, row + j) for j in range(count)]
    # The next row has one entry less before that column.
    places = [place + (b - begin[0]) - j for j, b in enumerate(begin)]
    factors = [at(u, p) * at(u, b) for p, b in zip(places, begin, strict=True)]

    def subtract(q: IntScalar, work: Array) -> Array:
        terms: Any = sum(f * at(u, q + (p - place)) for f, p in zip(factors, places, strict=True))
        return added(work, at(k.at, q), -terms)

    return lax.fori_loop(place, at(k.start, row + 1), subtract, work)


@jit
def solved(u: Float[Array, " filled"], b: Float[Array, " n"], k: SymbolicLDL) -> Float[Array, " n"]:
    """x with S x = b."""
    n = len(k.order)

    def forward(i: IntScalar, x: Array) -> Array:
        begin = at(k.start, i)
        value = at(x, i) * at(u, begin)
        less = lambda q, x: added(x, at(k.at, q), -value * at(u, q))
        return lax.fori_loop(begin + 1, at(k.start, i + 1), less, x)

    def backward(i: IntScalar, carry: Any) -> Any:
        x, out = carry
        i = n - 1 - i
        begin = at(k.start, i)
        less = lambda q, carry: (carry[0] - at(u, q) * at(carry[1], at(k.at, q)), carry[1])
        rest, _ = lax.fori_loop(begin + 1, at(k.start, i + 1), less, (at(x, i), x))
        value = rest * at(u, begin)
        return replaced(x, i, value), replaced(out, at(k.order, i), value)

    x = b.astype(jnp.result_type(u, b))[k.order]
    x = for_each_row(n, forward, x)
    return for_each_row(n, backward, (x, jnp.zeros_like(x)))[1]
