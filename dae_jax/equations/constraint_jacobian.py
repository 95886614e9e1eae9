"""The linear algebra of a mechanism's constraints at one point: A, M⁻¹Aᵀ and (A M⁻¹Aᵀ)⁻¹, dense; `sparse_constraint_jacobian` has
the sparse.

Both classes are hashable descriptions without numbers. `at` linearises, and what it returns, the Jacobian and what solves with
the Schur complement A M⁻¹Aᵀ need, is handed to the other methods; `ode` is the `MechanicalODE` that the constraints belong to.
"""

import dataclasses
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg import Factors, factorised, semidefinite_solve, solve_with
from ..linalg.semidefinite import LOOPED, UNROLLED, by_lapack
from ..structure import dependence
from ..types import Flat, Time
from .manifold_ode import ConstraintJacobian


# Up to this many multiplications a product is written as a sum, which can become part of a kernel; a dot cannot.
SUMMED = 4096

# How many constraints are independent: of the holonomic ones, and of all.
Rank = tuple[int, int]


@runtime_checkable
class Mechanism(Protocol):
    """What is asked of a `MechanicalODE`."""

    def mass(self, q: Flat) -> Array | None: ...
    def constraint(self, t: Time, q: Flat) -> Array: ...
    def constraint_jacobian(self, t: Time, q: Flat, v: Flat) -> Array: ...


@dataclasses.dataclass(frozen=True)
class DenseConstraintJacobian:
    """A as a matrix; `rank` where some of its rows depend on others."""

    holonomic: int
    nonholonomic: int
    rank: Rank | None

    def at(self, ode: Mechanism, t: Time, q: Flat, v: Flat) -> tuple[Array, ...]:
        """A and M⁻¹Aᵀ; and where solves with A M⁻¹Aᵀ are no straight-line code, or
        some constraints depend on others, that matrix, with a diagonal of 1, what made it so, and its factors.
        """
        a = ode.constraint_jacobian(t, q, v)
        n = mass_solve(ode.mass(q), a.T)
        if self.rank is None and not UNROLLED < len(a) <= LOOPED:
            return a, n
        schur = _matmul(a, n)
        scale = unit_diagonal(schur)
        schur = schur * scale[:, None] * scale
        counts = None if self.rank is None else ((self.holonomic, self.rank[0]), (len(a), self.rank[1]))
        return a, n, schur, scale, *factorised(schur, counts)

    def along(self, ode: Mechanism, jacobian: ConstraintJacobian, x: Float[Array, " n"]) -> Float[Array, " c"]:
        """A x."""
        return matvec(jacobian[0], x)

    def freed(self, ode: Mechanism, jacobian: ConstraintJacobian, q: Flat, force: Flat) -> Flat:
        """M⁻¹ f."""
        return mass_solve(ode.mass(q), force)

    def lift(self, ode: Mechanism, jacobian: ConstraintJacobian, mu: Float[Array, " c"]) -> Float[Array, " n"]:
        """M⁻¹Aᵀ μ, of the first constraints where μ is shorter."""
        return matvec(jacobian[1][:, : mu.shape[0]], mu)

    def schur_solve(self, ode: Mechanism, jacobian: ConstraintJacobian, b: Float[Array, " c"]) -> Float[Array, " c"]:
        """x with A M⁻¹Aᵀ x = b, of the first constraints where b is shorter; 0 where constraints depend on others."""
        c = b.shape[0]
        a, n, *rest = jacobian
        if not rest:
            return semidefinite_solve(_matmul(a[:c], n[:, :c]), b)
        schur, scale, *factors = rest
        # Pivots of the holonomic constraints come first.
        count = c if self.rank is None else self.rank[c > self.holonomic]
        return scale[:c] * solve_with(Factors(*factors).first(count, c), schur[:c, :c], scale[:c] * b)

    def least_norm(self, ode: Mechanism, jacobian: ConstraintJacobian, b: Float[Array, " c"]) -> Float[Array, " c"]:
        """The shortest such x, of b that satisfies all constraints."""
        if self.rank is None:
            return self.schur_solve(ode, jacobian, b)
        # Which constraints depend on each other has nothing to do with their scale.
        schur, scale = jacobian[2:4]
        count, columns = len(schur), jnp.concatenate([(scale * b)[:, None], schur], 1)
        solved = semidefinite_solve(schur, columns, self.rank[1])
        some, held = scale * solved[:, 0], solved[:, 1:]
        # How long an x is has. Of those that move nothing, as much is taken away as lies along them.
        idle = scale[:, None] * (jnp.eye(count, dtype=schur.dtype) - held)
        along = semidefinite_solve(_matmul(idle.T, idle), matvec(idle.T, some), count - self.rank[1])
        return some - matvec(idle, along)

    @staticmethod
    def independent(jacobian: ConstraintJacobian) -> Float[Array, " c"]:
        """1 for each of as many constraints as are independent, where some depend on others."""
        return Factors(*jacobian[4:]).kept()

    def lengths(self, ode: Mechanism, jacobian: ConstraintJacobian) -> Float[Array, " c"]:
        """The length of each row of A."""
        return jnp.sqrt(jnp.sum(jacobian[0] ** 2, 1))

    def reach(self, ode: Mechanism, jacobian: ConstraintJacobian, sizes: Float[Array, " n"]) -> Float[Array, " c"]:
        """|A| s: what changes of that size may move each by."""
        return matvec(jnp.abs(jacobian[0]), sizes)


def constraint_pattern(constraint: Callable[[Time, Flat], Array], t: Time, q: Flat) -> Bool[np.ndarray, "c n"] | None:
    """Which constraint depends on which coordinate; `None` where that cannot be read off."""
    try:
        return dependence(lambda q: constraint(t, q), jax.ShapeDtypeStruct(q.shape, q.dtype), derivative=True)[0]
    except NotImplementedError:
        return None


def mass_solve(
    mass: Float[Array, "..."] | None, x: Float[Array, "n *k"], solved: Callable[..., Array] = semidefinite_solve
) -> Float[Array, "n *k"]:
    """M⁻¹ x for M as `ConstrainedSystem.mass_matrix` gives it; `solved`: how a matrix is."""
    if mass is None:
        return x
    if mass.ndim < 2:
        return x / (mass[:, None] if mass.ndim and x.ndim == 2 else mass)
    if mass.ndim == 3:
        return jax.vmap(solved)(mass, x.reshape(*mass.shape[:2], *x.shape[1:])).reshape(x.shape)
    return solved(mass, x)


def dense_mass(mass: Float[Array, "..."] | None) -> Float[Array, "..."] | None:
    """The same, a block-diagonal matrix written out."""
    if mass is None or mass.ndim < 3:
        return mass
    count, k, _ = mass.shape
    return (jnp.eye(count, dtype=mass.dtype)[:, None, :, None] * mass[:, :, None, :]).reshape(count * k, count * k)


def of_rows(s: Float[Array, "c c"], kept: Float[Array, " c"]) -> Float[Array, "c c"]:
    """S with its rows and columns where `kept` is 1, elsewhere the unit matrix."""
    return s * kept[:, None] * kept + jnp.eye(len(s), dtype=s.dtype) * (1 - kept)


def shortest(
    a: Float[Array, "c n"], mass: Float[Array, "..."] | None, free: Float[Array, " n"], b: Float[Array, " c"]
) -> Float[Array, " n"]:
    """The shortest x with A x = b in the metric of the mass matrix, where entries that are not `free` stay 0; by LAPACK, as a program of
    its own.
    """
    n = mass_solve(of_free(mass, free), (a * free).T, by_lapack)
    schur = jnp.dot(a, n)
    # Rows of lengths beside those of angles are not dependent because their unit is small or large.
    scale = unit_diagonal(schur)
    schur = scale[:, None] * schur * scale
    cut = float(jnp.finfo(schur.dtype).eps) ** 0.5
    return jnp.dot(n, scale * jnp.dot(jnp.linalg.pinv(schur, rtol=cut, hermitian=True), scale * b))


def of_free(mass: Float[Array, "..."] | None, free: Float[Array, " n"]) -> Float[Array, "..."] | None:
    """The mass matrix of the entries that are free, for the others the unit matrix."""
    if mass is None or mass.ndim < 2:
        return mass
    if mass.ndim == 3:
        return jax.vmap(of_rows)(mass, free.reshape(mass.shape[:2]))
    return of_rows(mass, free)


def unit_diagonal(s: Float[Array, "c c"]) -> Float[Array, " c"]:
    """d that makes the diagonal of diag(d) S diag(d) ±1, or leaves a 0."""
    diagonal = jnp.abs(jnp.diagonal(s))
    return 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))


def _matmul(a: Float[Array, "i j"], b: Float[Array, "j k"]) -> Float[Array, "i k"]:
    if a.size * b.shape[1] > SUMMED:
        return jnp.dot(a, b, precision=jax.lax.Precision.HIGHEST)
    return jnp.sum(a[:, :, None] * b[None, :, :], 1)


def matvec(a: Float[Array, "i j"], x: Float[Array, " j"]) -> Float[Array, " i"]:
    """A x, as a sum, which can become part of a kernel."""
    return jnp.sum(a * x, 1)
