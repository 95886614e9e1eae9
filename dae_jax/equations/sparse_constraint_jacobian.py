"""The linear algebra of a mechanism's constraints at one point, sparse: see `constraint_jacobian`."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..linalg import Elimination, SparseDefinite, elimination, take
from ..linalg.semidefinite import LOOPED
from ..structure import column_colouring, seed_matrix
from ..types import Flat, Time
from .constraint_jacobian import Mechanism, mass_solve
from .directions import along_each
from .manifold_ode import ConstraintJacobian, traced_once


# Systems with fewer constraints are dense: their elimination is straight-line code.
SPARSE_FROM = 5


@dataclasses.dataclass(frozen=True, eq=False)
class SparseConstraintJacobian:
    """A by its nonzeros, for holonomic constraints and unit, diagonal or block-diagonal masses.

    A is compressed to C = A S, one directional derivative of the constraints a colour, in which row i has at most one
    column `columns[c, i]` of colour c; C has its colours as the last axis, along which it is computed. The entries of A M⁻¹Aᵀ
    are then sums over the colours. Products with A and Aᵀ are derivatives of the constraints themselves. Where masses are
    blocks, M = L Lᵀ, C is that of A L⁻ᵀ, whose masses are 1; a row of it has all columns of a block of which A has one.
    Compared by identity: keep one for each pattern.
    """

    columns: Int[np.ndarray, "colours c"]
    seeds: Float[np.ndarray, "n colours"]
    schur: Elimination | SparseDefinite

    @traced_once
    def at(self, ode: Mechanism, t: Time, q: Flat, v: Flat) -> tuple[Array | None, ...]:
        """The point, the masses (L of blocks), C there, and the factors of A M⁻¹Aᵀ where its elimination is a loop."""
        mass, seeds = ode.mass(q), jnp.asarray(self.seeds, q.dtype)
        if mass is not None and mass.ndim == 3:
            mass = jnp.linalg.cholesky(mass)
            seeds = _unweighted(mass, seeds)
        compressed = self._compressed(ode, t, q, seeds)
        point = jnp.asarray(t, q.dtype), q, mass, compressed
        if not isinstance(self.schur, SparseDefinite):
            return point
        return *point, *self.schur.factors(*self._products(mass, compressed))

    def _compressed(
        self, ode: Mechanism, t: Time, q: Flat, seeds: Float[Array, "n colours"]
    ) -> Float[Array, "c colours"]:
        return along_each(functools.partial(ode.constraint, t), q, seeds)

    @traced_once
    def along(self, ode: Mechanism, jacobian: ConstraintJacobian, x: Float[Array, " n"]) -> Float[Array, " c"]:
        """A x."""
        t, q, *_ = jacobian
        return jax.jvp(functools.partial(ode.constraint, t), (q,), (x,))[1]

    def freed(self, ode: Mechanism, jacobian: ConstraintJacobian, q: Flat, force: Flat) -> Flat:
        """M⁻¹ f."""
        mass = jacobian[2]
        if mass is None or mass.ndim < 3:
            return mass_solve(mass, force)
        half = jax.scipy.linalg.solve_triangular(mass, force.reshape(mass.shape[:2])[..., None], lower=True)
        return jax.scipy.linalg.solve_triangular(mass, half, trans=1, lower=True).reshape(force.shape)

    @traced_once
    def lift(self, ode: Mechanism, jacobian: ConstraintJacobian, mu: Float[Array, " c"]) -> Float[Array, " n"]:
        """M⁻¹Aᵀ μ."""
        t, q, *_ = jacobian
        _, transpose = jax.vjp(functools.partial(ode.constraint, t), q)
        return self.freed(ode, jacobian, q, transpose(mu)[0])

    @traced_once
    def schur_solve(self, ode: Mechanism, jacobian: ConstraintJacobian, b: Float[Array, " c"]) -> Float[Array, " c"]:
        """x with A M⁻¹Aᵀ x = b."""
        _, _, mass, compressed, *factors = jacobian
        found = self._products(mass, compressed)
        if isinstance(self.schur, SparseDefinite):
            return self.schur.solve(*found, b, factors)
        return self.schur.solve(*found, b)

    def _products(
        self, mass: Float[Array, "..."] | None, compressed: Float[Array, "c colours"]
    ) -> tuple[Float[Array, " c"], Float[Array, " couplings"]]:
        """The diagonal of A M⁻¹Aᵀ, and its couplings."""
        weighted = compressed if mass is None or mass.ndim == 3 else compressed * self._inverse_masses(mass)
        at = lambda x, places: jnp.ravel(x).at[places].get(mode="promise_in_bounds")
        diagonal = jnp.sum(weighted * compressed, 1)
        found = [jnp.sum(at(weighted, i) * at(compressed, j), 0) for _, i, j in self._shared]
        if not found:
            return diagonal, diagonal[:0]
        order = np.argsort(np.concatenate([couplings for couplings, *_ in self._shared]))
        return diagonal, take(jnp.concatenate(found), order)

    @functools.cached_property
    def _shared(self) -> list[tuple[Int[np.ndarray, " k"], Int[np.ndarray, "s k"], Int[np.ndarray, "s k"]]]:
        """The couplings of rows that share s columns, and where in C each of both rows has them: for each s that there is."""
        rows, columns, colours = self.schur.rows, self.schur.columns, len(self.columns)
        shared = (self.columns[:, rows] == self.columns[:, columns]) & (self.columns[:, rows] >= 0)
        counts, found = shared.sum(0), []
        for count in np.unique(counts):
            of = np.flatnonzero(counts == count)
            colour = np.argsort(~shared[:, of], 0, kind="stable")[:count]
            found.append((of, colours * rows[of] + colour, colours * columns[of] + colour))
        return found

    def least_norm(self, ode: Mechanism, jacobian: ConstraintJacobian, b: Float[Array, " c"]) -> Float[Array, " c"]:
        """The only such x: no constraint depends on others."""
        return self.schur_solve(ode, jacobian, b)

    @traced_once
    def lengths(self, ode: Mechanism, jacobian: ConstraintJacobian) -> Float[Array, " c"]:
        """The length of each row of A."""
        return jnp.sqrt(jnp.sum(self._entries(ode, jacobian) ** 2, 1))

    @traced_once
    def reach(self, ode: Mechanism, jacobian: ConstraintJacobian, sizes: Float[Array, " n"]) -> Float[Array, " c"]:
        """|A| s: what changes of that size may move each constraint by."""
        return jnp.sum(jnp.abs(self._entries(ode, jacobian)) * sizes[np.maximum(self.columns.T, 0)], 1)

    def _entries(self, ode: Mechanism, jacobian: ConstraintJacobian) -> Float[Array, "c colours"]:
        """C of A itself, whatever the masses."""
        t, q, mass, compressed, *_ = jacobian
        if mass is not None and mass.ndim == 3:
            return self._compressed(ode, t, q, jnp.asarray(self.seeds, q.dtype))
        return compressed

    def _inverse_masses(self, mass: Float[Array, "..."]) -> Float[Array, "c colours"]:
        return 1 / (jnp.broadcast_to(mass, (len(self.seeds),))[np.maximum(self.columns.T, 0)])


def sparse_constraint_jacobian(pattern: Bool[np.ndarray, "c n"], block: int = 1) -> SparseConstraintJacobian | None:
    """The sparse form for A with this pattern, where it takes fewer operations than the dense one; `block`: the rows of a block
    of the mass matrix.
    """
    pattern = np.repeat(pattern.reshape(len(pattern), -1, block).any(2), block, 1)
    found = _sparse_constraint_jacobian(pattern.tobytes(), pattern.shape)
    return found if found.schur.cost < len(pattern) ** 3 // 3 else None


@functools.lru_cache(maxsize=64)
def _sparse_constraint_jacobian(pattern: bytes, shape: tuple[int, int]) -> SparseConstraintJacobian:
    nonzero = np.frombuffer(pattern, bool).reshape(shape)
    colours = column_colouring(nonzero)
    columns = np.full((colours.max() + 1, shape[0]), -1)
    for i, j in np.argwhere(nonzero):
        columns[colours[j], i] = j
    shared = nonzero.astype(np.int32)
    schur = shared @ shared.T > 0
    order: Elimination | SparseDefinite = elimination(schur)
    # What would be left to LAPACK.
    if order.rest_size > LOOPED and SparseDefinite.of(schur).cost < order.cost:
        order = SparseDefinite.of(schur)
    return SparseConstraintJacobian(columns, seed_matrix(colours), order)


def _unweighted(factor: Float[Array, "b k k"], seeds: Float[Array, "n colours"]) -> Float[Array, "n colours"]:
    """L⁻ᵀ of the blocks times each seed."""
    by_block = seeds.reshape(*factor.shape[:2], -1)
    return jax.scipy.linalg.solve_triangular(factor, by_block, trans=1, lower=True).reshape(seeds.shape)
