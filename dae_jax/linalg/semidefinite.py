"""Symmetric positive (semi)definite systems S x = b, such as G M⁻¹ Gᵀ λ = b."""

import functools
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from ..types import IntScalar
from .definite_factors import definite_pivot, factorised, solve_with


# Up to UNROLLED unknowns the elimination is straight-line code; up to LOOPED a loop over columns, which still compiles
# into one kernel; LAPACK above.
UNROLLED = 8
LOOPED = 48


def semidefinite_solve(
    s: Float[Array, "m m"], b: Float[Array, "m *k"], rank: int | None = None
) -> Float[Array, "m *k"]:
    """x with S x = b for symmetric positive definite S, or of the least norm where S has the given `rank` < m.

    The definite case is S = L D Lᵀ without pivoting (stable for definite S: Higham, *Accuracy and Stability of
    Numerical Algorithms*, ch. 10). A pivot that is not positive beyond round-off gives NaN: the system is not definite,
    and no number would be right.

    In the semidefinite case the `rank` largest eigenvalues are kept, by LAPACK; NaN where one of them is round-off.
    """
    m = s.shape[0]
    if rank == 0:
        return jnp.zeros_like(b)
    if rank is not None and rank < m:
        return jnp.dot(_pseudo_inverse(s, rank), b)
    if m > LOOPED:
        return by_lapack(s, b)
    if m > UNROLLED:
        return solve_with(factorised(s), s, b)
    return _by_determinant(s, b) if m == 2 else _unrolled(s, b)


def by_lapack(s: Float[Array, "m m"], b: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    """The same of definite S, of any size a short program; NaN where S is not definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(s, lower=True), b)


def smallest_pivot(s: Float[Array, "m m"]) -> Float[Array, ""]:
    """The smallest pivot of symmetric S = L D Lᵀ, of round-off size where S is singular; not less than its smallest
    eigenvalue.
    """

    def eliminate(j: IntScalar, carry):
        s, smallest = carry
        pivot = s[j, j]
        row = s[j] / jnp.where(pivot > 0, pivot, 1)
        return s - s[:, j][:, None] * row, jnp.minimum(smallest, pivot)

    return jax.lax.fori_loop(0, s.shape[0], eliminate, (s, jnp.asarray(jnp.inf, s.dtype)))[1]


def _by_determinant(s: Float[Array, "2 2"], b: Float[Array, "2 *k"]) -> Float[Array, "2 *k"]:
    """Cramer's rule: one division where elimination waits for two, and as accurate for two unknowns (Higham, 1.10.1)."""
    product, determinant = s[0, 0] * s[1, 1], s[0, 0] * s[1, 1] - s[1, 0] * s[1, 0]
    definite = (s[0, 0] > 0) & (determinant > 16 * float(jnp.finfo(s.dtype).eps) * product)
    inverse = jnp.where(definite, 1 / determinant, jnp.nan)
    return jnp.stack([(s[1, 1] * b[0] - s[1, 0] * b[1]) * inverse, (s[0, 0] * b[1] - s[1, 0] * b[0]) * inverse])


def _unrolled(s: Float[Array, "m m"], b: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    m = s.shape[0]
    at_hand = lax.stop_gradient(s)
    lower: list[list[Array]] = []  # L D, row by row
    unit: list[list[Array]] = []  # L
    inverse: list[Array] = []  # 1 / D
    for i in range(m):
        row: list[Array] = []
        for j in range(i):
            row.append(at_hand[i, j] - _sum(row[k] * unit[j][k] for k in range(j)))
        lower.append(row)
        unit.append([x * inverse[k] for k, x in enumerate(row)])
        pivot = at_hand[i, i] - _sum(x * y for x, y in zip(row, unit[i], strict=True))
        inverse.append(1 / definite_pivot(pivot, at_hand[i, i], m))
    if not m:
        return b
    # A custom derivative would be forgotten in reverse mode, and the factors stand still in second derivatives.
    inverted = lambda _, b: _substituted(lower, unit, inverse, b)
    product = lambda x: jnp.sum(s.reshape(*s.shape, *[1] * (x.ndim - 1)) * x, 1)
    return lax.custom_linear_solve(product, b, inverted, inverted, symmetric=True)


def _substituted(
    lower: list[list[Array]], unit: list[list[Array]], inverse: list[Array], b: Float[Array, "m *k"]
) -> Float[Array, "m *k"]:
    x, m = [], len(b)
    for i in range(m):
        x.append((b[i] - _sum(lower[i][k] * x[k] for k in range(i))) * inverse[i])
    for i in reversed(range(m)):
        x[i] = x[i] - _sum(unit[k][i] * x[k] for k in range(i + 1, m))
    return jnp.stack(x)


def _sum(terms: Iterable[Array]):
    terms = list(terms)
    return sum(terms[1:], terms[0]) if terms else 0.0


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _pseudo_inverse(s: Float[Array, "m m"], rank: int) -> Float[Array, "m m"]:
    """S⁺ of symmetric S of constant rank. Its derivatives, of any order, are in terms of S⁺: those of eigenvectors, of which there are
    none where eigenvalues are equal, are not in them.
    """
    values, vectors = jnp.linalg.eigh(s)
    least = 8 * s.shape[0] * float(jnp.finfo(s.dtype).eps) * values[-1]
    values = jnp.where(values[s.shape[0] - rank] > least, values, jnp.nan)
    values, vectors = values[s.shape[0] - rank :], vectors[:, s.shape[0] - rank :]
    return jnp.dot(vectors / values, vectors.T)


@_pseudo_inverse.defjvp
def _(rank: int, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    # Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973), eq. 4.12, for symmetric S.
    (s,), (ds,) = primals, tangents
    inverse = _pseudo_inverse(s, rank)
    beyond = jnp.eye(s.shape[0], dtype=s.dtype) - jnp.dot(s, inverse)
    into_null_space = jnp.dot(beyond.T, jnp.dot(ds, jnp.dot(inverse, inverse)))
    return inverse, into_null_space + into_null_space.T - jnp.dot(inverse, jnp.dot(ds, inverse))
