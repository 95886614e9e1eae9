"""Factors of a symmetric, positive (semi)definite matrix, found once for several right-hand sides, in loops that compile quickly."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..types import IntScalar


# A row of length 1 is independent of others beyond doubt where this part of the square of its length is.
CLEAR = 0.01


class Factors(NamedTuple):
    """S = Σₖ dₖ uₖ uₖᵀ on the rows `order`, in which the pivots dₖ were taken; uₖ is 1 at the k-th of them."""

    rows: Float[Array, "r m"]
    pivots: Float[Array, " r"]
    order: Int[Array, " r"]

    def first(self, count: int, size: int) -> "Factors":
        """Those of the first `count` pivots, which are in the first `size` rows and columns."""
        return Factors(self.rows[:count, :size], self.pivots[:count], self.order[:count])

    def kept(self) -> Float[Array, " m"]:
        """1 at the rows that were taken, 0 at the others."""
        return jnp.zeros(self.rows.shape[1], self.rows.dtype).at[self.order].set(1)


def factorised(s: Float[Array, "m m"], counts: Sequence[tuple[int, int]] | None = None) -> Factors:
    """Without `counts`, of definite S in the order of its rows (stable: Higham, *Accuracy and Stability of Numerical Algorithms*,
    ch. 10); a pivot that is not positive beyond round-off is NaN.

    With `counts`, of as many rows of semidefinite S, whose diagonal is 1 (or 0), as are independent: for each (rows, rank), of the
    first `rows` rows there are to be `rank`, with those that are taken before. The first of those that are independent beyond doubt
    is taken, so that the choice does not change with round-off; where there is none, the one that is so the most.
    """
    m = len(s)
    s, place = lax.stop_gradient(s), jnp.arange(m)
    diagonal = jnp.sum(s * jnp.eye(m, dtype=s.dtype), 1)

    def eliminate(rows: int, carry: Any, k: IntScalar) -> Any:
        s, left, free = carry
        if counts is not None:
            left_over = jnp.where((place < rows) & free, left, -1)
            k = jnp.argmax(jnp.where(left_over > CLEAR, 2.0 + m - place, left_over))
        row = s[k]
        pivot = left[k]
        unit = row / jnp.where(pivot > 0, pivot, 1)
        pivot = definite_pivot(pivot, diagonal[k], m)
        return (s - row[:, None] * unit, left - row * unit, free & (place != k)), (unit, pivot, k)

    carry, found, done = (s, diagonal, jnp.ones(m, bool)), [], 0
    for rows, rank in counts or ((m, m),):
        carry, part = lax.scan(functools.partial(eliminate, rows), carry, jnp.arange(done, rank))
        found.append(part)
        done = rank
    return Factors(*(jnp.concatenate(parts) for parts in zip(*found, strict=True)))


def definite_pivot(pivot: Float[Array, "*k"], diagonal: Float[Array, "*k"], m: int) -> Float[Array, "*k"]:
    """The pivot of an m×m matrix, or NaN where it is round-off of the diagonal entry that it was."""
    return jnp.where(pivot > 8 * m * float(jnp.finfo(pivot.dtype).eps) * diagonal, pivot, jnp.nan)


def solve_with(factors: Factors, s: Float[Array, "m m"], b: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    """x with S x = b on the rows that the factors are of, and 0 elsewhere; `s` is what they are factors of, for derivatives."""
    at_hand, kept = lax.stop_gradient((factors, factors.kept()))
    of_kept = lambda x: x * kept.reshape(-1, *[1] * (x.ndim - 1))

    def apply(x: Float[Array, "m *k"]) -> Any:
        return of_kept(jnp.tensordot(s, of_kept(x), 1, precision=lax.Precision.HIGHEST))

    return lax.custom_linear_solve(
        apply, of_kept(b), lambda _, b: _substituted(at_hand, b), lambda _, b: _substituted(at_hand, b), symmetric=True
    )


def _substituted(factors: Factors, b: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    def forwards(left: Any, at: tuple[Array, Array]) -> Any:
        row, k = at
        return left - jnp.tensordot(row, left[k], 0), left[k]

    def backwards(x: Any, at: tuple[Array, Array, Array]) -> Any:
        row, k, value = at
        return x.at[k].set(value - jnp.sum(row.reshape(-1, *[1] * (x.ndim - 1)) * x, 0)), None

    _, values = lax.scan(forwards, b, (factors.rows, factors.order))
    values = values / factors.pivots.reshape(-1, *[1] * (b.ndim - 1))
    x, _ = lax.scan(backwards, jnp.zeros_like(b), (factors.rows, factors.order, values), reverse=True)
    return x
