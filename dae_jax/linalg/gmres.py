"""The generalised minimal residual method, for real and complex matrices of which only products are known.

Source: Y. Saad, *Iterative Methods for Sparse Linear Systems*, 2nd ed., algorithms 6.9 and 9.5 (preconditioned from the right).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Inexact, Int

from ..types import Scalar


Vectors = Callable[[Inexact[Array, " n"]], Inexact[Array, " n"]]


class _Krylov(NamedTuple):
    """An orthonormal `basis` of the Krylov space after `count` vectors; the triangle that rotations make of the Hessenberg matrix; the
    `rotations` (c, s); the right-hand side rotated, whose last number is what is `left` of the residual.
    """

    basis: Inexact[Array, "m+1 n"]
    triangle: Inexact[Array, "m m"]
    rotations: Inexact[Array, "m 2"]
    right: Inexact[Array, " m+1"]
    count: Int[Array, ""]
    left: Scalar


def gmres(
    apply: Vectors, precondition: Vectors, b: Inexact[Array, " n"], *, rtol: float, restart: int, most: int
) -> tuple[Inexact[Array, " n"], Bool[Array, ""]]:
    """x with |A x − b| ≤ `rtol` |b| in the Euclidean norm, and whether it was found with at most `most` products A x.

    `precondition` is about A⁻¹; a new space is begun after `restart` vectors, and where what is left has ceased to shrink
    the method ends.
    """
    allowed = rtol * jnp.sqrt(_square(b))

    def goes_on(carry: Any) -> Bool[Array, ""]:
        _, _, size, before, count = carry
        return (size > allowed) & (size < before) & (count < most)

    def improve(carry: Any) -> Any:
        x, residual, size, _, count = carry
        space = _space(apply, precondition, residual, size, allowed, restart, most - count)
        x = x + precondition(_least(space) @ space.basis[:-1])
        residual = b - apply(x)
        return x, residual, jnp.sqrt(_square(residual)), size, count + space.count

    size = jnp.sqrt(_square(b))
    x, _, size, _, _ = lax.while_loop(goes_on, improve, (jnp.zeros_like(b), b, size, jnp.inf * size, jnp.asarray(0)))
    return x, size <= allowed


def _space(
    apply: Vectors, precondition: Vectors, first: Any, size: Any, allowed: Any, restart: int, most: Any
) -> _Krylov:
    """The Krylov space of A M⁻¹ that begins with the residual `first`, until what is left of it is `allowed`."""
    dtype = first.dtype
    empty = _Krylov(
        jnp.zeros((restart + 1, first.size), dtype).at[0].set(first / size),
        jnp.eye(restart, dtype=dtype),
        jnp.zeros((restart, 2), dtype),
        jnp.zeros(restart + 1, dtype).at[0].set(size.astype(dtype)),
        jnp.asarray(0),
        size,
    )

    def add(space: _Krylov) -> _Krylov:
        k = space.count
        vector = apply(precondition(space.basis[k]))
        # Twice, which is as good as one after another (Saad, section 6.3.2). Vectors that are not there yet are 0.
        once = space.basis.conj() @ vector
        vector = vector - once @ space.basis
        twice = space.basis.conj() @ vector
        vector = vector - twice @ space.basis
        length = jnp.sqrt(_square(vector))
        column = _rotated((once + twice)[:-1], space.rotations, k)
        rotation, diagonal = _rotation(column[k], length)
        last = space.right[k]
        right = space.right.at[k].set(rotation[0].conj() * last).at[k + 1].set(-rotation[1] * last)
        at = jnp.arange(restart)
        return _Krylov(
            space.basis.at[k + 1].set(vector / jnp.where(length > 0, length, 1)),
            space.triangle.at[:, k].set(jnp.where(at < k, column, jnp.where(at == k, diagonal, 0))),
            space.rotations.at[k].set(rotation),
            right,
            k + 1,
            jnp.abs(right[k + 1]),
        )

    return lax.while_loop(lambda space: (space.left > allowed) & (space.count < jnp.minimum(restart, most)), add, empty)


def _rotated(column: Array, rotations: Array, k: Int[Array, ""]) -> Array:
    """The column after the first k rotations, each of entries i and i + 1."""

    def rotate(i: Any, column: Array) -> Array:
        (c, s), above, below = rotations[i], column[i], column[i + 1]
        return column.at[i].set(c.conj() * above + s.conj() * below).at[i + 1].set(c * below - s * above)

    return lax.fori_loop(0, k, rotate, column)


def _rotation(above: Array, length: Array) -> tuple[Array, Array]:
    """(c, s), which takes (`above`, `length`) to (r, 0), and r."""
    size = jnp.sqrt(_square(above) + length * length)
    size = jnp.where(size > 0, size, 1)
    return jnp.stack([above / size, (length / size).astype(above.dtype)]), size.astype(above.dtype)


def _least(space: _Krylov) -> Array:
    """The combination of the basis that makes the residual least, by back substitution."""
    m = len(space.triangle)
    used = jnp.where(jnp.arange(m) < space.count, space.right[:-1], 0)

    def solve(i: Any, y: Array) -> Array:
        k = m - 1 - i
        return y.at[k].set((used[k] - space.triangle[k] @ y) / space.triangle[k, k])

    return lax.fori_loop(0, m, solve, jnp.zeros_like(used))


def _square(x: Array) -> Array:
    return jnp.sum(jnp.real(x * x.conj()))
