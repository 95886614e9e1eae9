"""The underlying ODE of a mechanism with constraints, and the manifold that it lives on."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._compat import is_a_loop_without_reverse, lacks_reverse_derivatives
from ..linalg import fixed_point, implicit_root, relative_change, roundoff, solve
from ..structure.layout import Layout
from ..systems import ConstrainedSystem
from ..types import Args, DType, Flat, Phase, State, Time
from .constraint_jacobian import DenseConstraintJacobian, Rank, constraint_pattern, of_rows
from .manifold_ode import ConstraintJacobian, Feedback, ManifoldODE, at_one_instant
from .sparse_constraint_jacobian import SPARSE_FROM, SparseConstraintJacobian, sparse_constraint_jacobian


# From so many constraints on the forces of multipliers are found by reverse derivatives, at the price of the constraints. Of fewer by
# forward ones, which take no longer then, and which a branch that is not taken cannot make NaN.
REVERSE_FROM = 8

# A correction may be round-off of numbers near 1 in a constraint where it is so many times smaller beside 1 than it may be beside what is
# in the constraint.
NEAR_1 = 100


def allowed_contradiction(dtype: DType) -> float:
    """The part of the accelerations that dependent constraints ask for in which they may disagree."""
    return max(1e-6, float(jnp.finfo(dtype).eps) ** 0.5)


class MechanicalODE(ManifoldODE):
    """The underlying ODE of a `ConstrainedSystem`: y = (q, v),

        q̇ = v,   M v̇ + Aᵀλ = f,   A v̇ + γ = 0,   A = [∂g/∂q; ∂h/∂v],   γ = [d(Gv + g_t)/dt; dh/dt] at v̇ = 0,

    with the invariants g = 0 (position level) and (Gv + g_t, h) = 0 (velocity level).
    """

    system: ConstrainedSystem
    args: Any
    layout: Layout = eqx.field(static=True)
    holonomic: int = eqx.field(static=True)
    nonholonomic: int = eqx.field(static=True)
    depends_on_time: tuple[bool, bool] = eqx.field(static=True)
    linear: DenseConstraintJacobian | SparseConstraintJacobian = eqx.field(static=True)

    @classmethod
    def of(
        cls, system: ConstrainedSystem, t: Time, state: State, args: Args, rank: int | Rank | None = None
    ) -> "MechanicalODE":
        """Finds, while tracing, what the system has and has not; `state` = (q, v) gives shapes and types only."""
        q, v = state
        system, args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, (system, args))
        layout = Layout.of(q)
        g, g_uses_time = _outline(system.constraint, t, q, args)
        h, h_uses_time = _outline(system.nonholonomic, t, q, v, args)
        rank = system.rank if rank is None else rank
        if isinstance(rank, int):
            rank = (rank if not h else max(rank - h, 0), rank)
        rank = None if rank == (g, g + h) else rank
        ode = cls(system, args, layout, g, h, (g_uses_time, h_uses_time), DenseConstraintJacobian(g, h, rank))
        sparse = ode._sparse(t, layout.flatten(q)) if h == 0 and g >= SPARSE_FROM and rank is None else None
        return ode if sparse is None else dataclasses.replace(ode, linear=sparse)

    def _sparse(self, t: Time, q: Flat) -> SparseConstraintJacobian | None:
        mass = jax.eval_shape(self.mass, q)
        pattern = constraint_pattern(self.constraint, t, q) if mass is None or mass.ndim != 2 else None
        block = mass.shape[1] if mass is not None and mass.ndim == 3 else 1
        return None if pattern is None else sparse_constraint_jacobian(pattern, block)

    @property
    def rank(self) -> Rank | None:
        """How many constraints are independent, where some are redundant: of the holonomic ones, and of all."""
        return self.linear.rank if isinstance(self.linear, DenseConstraintJacobian) else None

    def decode(self, t: Time, y: Phase) -> Any:
        q, v = y
        return self.layout.unflatten(q), self.layout.unflatten(v)

    def encode(self, state: State) -> Any:
        """The flat vectors (q, v)."""
        q, v = state
        return self.layout.flatten(q), self.layout.flatten(v)

    def tolerances(self, t: Time, y: Phase, each: State, absolute: bool) -> Any:
        """A tolerance for each number of y, of one for `each` of the state."""
        return self.encode(each)

    # The system's functions on flat vectors

    def force(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """f(t, q, v)."""
        flat = self.layout.unflatten
        return self.layout.flatten(self.system.force(t, flat(q), flat(v), self.args)).astype(q.dtype)

    def unchecked_mass(self, q: Float[Array, " n"]) -> Float[Array, "..."] | None:
        """M(q) as the system has it: `None`, a vector (diagonal), blocks on the diagonal or a matrix."""
        mass = self.system.mass_matrix(self.layout.unflatten(q), self.args)
        return None if mass is None else mass.astype(q.dtype)

    def mass(self, q: Float[Array, " n"]) -> Float[Array, "..."] | None:
        """M(q); NaN where a function has made a mass negative or a matrix asymmetric: methods use one triangle."""
        mass = self.unchecked_mass(q)
        if mass is None or not callable(self.system.mass):
            return mass
        sizes = jax.lax.stop_gradient(mass)
        if mass.ndim < 2:
            return jnp.where(sizes >= 0, mass, jnp.nan)
        asymmetry = jnp.max(jnp.abs(sizes - jnp.swapaxes(sizes, -1, -2)))
        symmetric = asymmetry <= jnp.finfo(q.dtype).eps ** 0.75 * jnp.max(jnp.abs(sizes))
        return jnp.where(symmetric, mass, jnp.nan)

    def constraint(self, t: Time, q: Float[Array, " n"]) -> Float[Array, " m"]:
        """g(t, q)."""
        if self.system.constraint is None:
            return jnp.zeros(0, q.dtype)
        return jnp.ravel(self.system.constraint(t, self.layout.unflatten(q), self.args)).astype(q.dtype)

    def velocity_constraint(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " mp"]:
        """(ġ, h) = (G v + g_t, h(t, q, v))."""
        _, velocity = self._along(self.constraint, self.depends_on_time[0], t, (q,), (v,))
        if self.system.nonholonomic is None:
            return velocity
        return jnp.concatenate([velocity, self._nonholonomic(t, q, v)])

    def _nonholonomic(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " p"]:
        assert self.system.nonholonomic is not None
        flat = self.layout.unflatten
        return jnp.ravel(self.system.nonholonomic(t, flat(q), flat(v), self.args)).astype(q.dtype)

    @staticmethod
    def _along(
        function: Callable[..., Any], uses_time: bool, t: Time, at: tuple[Flat, ...], direction: tuple[Flat, ...]
    ) -> Any:
        """`function(t, *at)` and its derivative along (1, *direction); along (0, *direction) if it does not use time."""
        if uses_time:
            t = jnp.asarray(t, at[0].dtype)
            return jax.jvp(function, (t, *at), (jnp.ones_like(t), *direction))
        return jax.jvp(functools.partial(function, t), at, direction)

    def constraint_jacobian(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, "mp n"]:
        """A = [G; ∂h/∂v]."""
        rows = []
        if self.holonomic:
            rows.append(jax.jacfwd(self.constraint, 1)(t, q))
        if self.nonholonomic:
            rows.append(jax.jacfwd(self._nonholonomic, 2)(t, q, v))
        return jnp.concatenate(rows) if len(rows) > 1 else rows[0]

    def reaction(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Callable[[Flat], Array]:
        """(λ, μ) ↦ Aᵀ(λ, μ), and λ ↦ Gᵀλ of as many numbers as there are holonomic constraints."""
        if self.holonomic + self.nonholonomic < REVERSE_FROM:
            return _transposed(self.constraint_jacobian(t, q, v))
        maps = [_transposed_jacobian(functools.partial(self.constraint, t), q)] if self.holonomic else []
        maps += [_transposed_jacobian(functools.partial(self._nonholonomic, t, q), v)] if self.nonholonomic else []

        def pull(multipliers: Flat) -> Array:
            parts = jnp.split(multipliers, [self.holonomic]) if len(maps) > 1 else [multipliers]
            forces = (along(part) for along, part in zip(maps, parts, strict=True) if part.size)
            return sum(forces, jnp.zeros_like(q))

        return pull

    def bias(self, t: Time, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " mp"]:
        """γ, the second derivative of g and the first of h where v̇ = 0."""
        uses_time = self.depends_on_time[0] or self.depends_on_time[1]
        _, bias = self._along(lambda t, q: self.velocity_constraint(t, q, v), uses_time, t, (q,), (v,))
        return bias

    # The underlying ODE

    @at_one_instant
    def field(self, t: Time, y: Phase, feedback: Feedback | None = None) -> Any:
        q, v = y
        return v, self._accelerations(t, q, v, feedback)

    @at_one_instant
    def multipliers(self, t: Time, y: Phase) -> Float[Array, " mp"]:
        """(λ, μ), of least norm where constraints are redundant."""
        jacobian, _, target = self._free(t, *y)
        return self.linear.least_norm(self, jacobian, target)

    def _free(self, t: Time, q: Flat, v: Flat) -> tuple[ConstraintJacobian, Float[Array, " n"], Float[Array, " mp"]]:
        """The Jacobian, M⁻¹f, and A M⁻¹f + γ, which is A M⁻¹Aᵀ(λ, μ)."""
        jacobian = self.jacobian(t, (q, v))
        free = self.linear.freed(self, jacobian, q, self.force(t, q, v))
        return jacobian, free, self.linear.along(self, jacobian, free) + self.bias(t, q, v)

    def _accelerations(self, t: Time, q: Flat, v: Flat, feedback: Feedback | None) -> Float[Array, " n"]:
        jacobian, free, target = self._free(t, q, v)
        if feedback is not None:
            target = target + self._feedback(t, q, v, feedback)
        pulled = self.linear.lift(self, jacobian, self.linear.schur_solve(self, jacobian, target))
        if self.rank is not None:
            pulled = self._unless_contradictory(t, (q, v), jacobian, target, pulled)
        return free - pulled

    def _unless_contradictory(
        self, t: Time, y: Phase, jacobian: ConstraintJacobian, target: Float[Array, " c"], pulled: Flat
    ) -> Any:
        """x = M⁻¹Aᵀλ, or NaN where it leaves more of A x = b than y is off the constraints: dependent ones disagree."""
        lengths = self.linear.lengths(self, jacobian)
        lengths = jnp.where(lengths > 0, lengths, 1)
        off = jnp.max(jnp.abs(self.linear.along(self, jacobian, pulled) - target) / lengths)
        drift = jnp.max(jnp.concatenate(self.distances(t, y)))
        allowed = (allowed_contradiction(drift.dtype) + 10 * drift) * (1 + jnp.max(jnp.abs(target) / lengths))
        return jnp.where(off <= allowed, pulled, jnp.nan)

    def _feedback(self, t: Time, q: Flat, v: Flat, feedback: Feedback) -> Float[Array, " mp"]:
        velocity = self.velocity_constraint(t, q, v)
        terms = []
        if self.holonomic:
            terms.append(feedback(self.constraint(t, q), velocity[: self.holonomic]))
        if self.nonholonomic:
            terms.append(feedback(velocity[self.holonomic :]))
        return jnp.concatenate(terms) if len(terms) > 1 else terms[0]

    # The manifold

    @at_one_instant
    def distances(self, t: Time, y: Phase) -> tuple[Float[Array, " m"], Float[Array, " mp"]]:
        """The invariants divided by the length of each constraint's gradient: about how far y is from satisfying them."""
        lengths = self.linear.lengths(self, self.jacobian(t, y))
        lengths = jnp.where(lengths > 0, lengths, 1)
        g, velocity = self.invariants(t, y)
        return jnp.abs(g) / lengths[: self.holonomic], jnp.abs(velocity) / lengths

    @at_one_instant
    def sizes(self, t: Time, y: Phase, of: Phase) -> tuple[Float[Array, " m"], Float[Array, " mp"]]:
        """What counts as the size of the state for each constraint, in units of `distances`: Σ |Aᵢⱼ| sⱼ / |Aᵢ| for coordinates and
        speeds of the sizes `of`. A large one says nothing of a constraint in which it does not occur.
        """
        jacobian = self.jacobian(t, y)
        lengths = self.linear.lengths(self, jacobian)
        lengths = jnp.where(lengths > 0, lengths, 1)
        positions, velocities = (self.linear.reach(self, jacobian, s) / lengths for s in of)
        return positions[: self.holonomic], velocities

    @at_one_instant
    def invariants(self, t: Time, y: Phase) -> tuple[Float[Array, " m"], Float[Array, " mp"]]:
        q, v = y
        return self.constraint(t, q), self.velocity_constraint(t, q, v)

    @at_one_instant
    def jacobian(self, t: Time, y: Phase) -> Any:
        """A, as `DenseConstraintJacobian` and `SparseConstraintJacobian` have it."""
        return self.linear.at(self, t, *y)

    @at_one_instant
    def tangent(self, dy: Phase, jacobian: ConstraintJacobian) -> Any:
        dq, dv = dy
        return self._tangent(jacobian, dq, self.holonomic), self._tangent(jacobian, dv, None)

    def _tangent(self, jacobian: ConstraintJacobian, x: Float[Array, " n"], rows: int | None) -> Float[Array, " n"]:
        off = self.linear.along(self, jacobian, x)[:rows]
        return x - self.linear.lift(self, jacobian, self.linear.schur_solve(self, jacobian, off)) if off.size else x

    def displace(self, y: Phase, jacobian: ConstraintJacobian, mu: Float[Array, " c"]) -> Any:
        q, v = y
        m = self.holonomic
        return q + self.linear.lift(self, jacobian, mu[:m]), v + self.linear.lift(self, jacobian, mu[m:])

    def retract_along(self, t: Time, y: Phase, jacobian: ConstraintJacobian) -> tuple[Any, Bool[Array, ""]]:
        return self._retracted(t, y, jacobian, self._corrected(t, y, jacobian, self.jacobian(t, y)))

    def project(self, t: Time, y: Phase) -> tuple[Any, Bool[Array, ""]]:
        jacobian = self.jacobian(t, y)
        return self._retracted(t, y, jacobian, self._corrected(t, y, jacobian, jacobian))

    def _retracted(
        self, t: Time, y: Phase, jacobian: ConstraintJacobian, first: tuple[Any, Any]
    ) -> tuple[Any, Bool[Array, ""]]:
        def iterate(params: PyTree) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
            *point, first = params
            return fixed_point(lambda mu: MechanicalODE.correction(*point, mu), *first)

        params = (self, t, y, jacobian, tuple(jax.lax.stop_gradient(first)))
        mu, found = implicit_root(
            _manifold_residual, iterate, params, linear_solve=_on_rows, jacobian=_manifold_jacobian
        )
        displaced = self.displace(y, jacobian, mu)
        return displaced, found if self.rank is None else found & self._all_hold(t, displaced)

    def _all_hold(self, t: Time, y: Phase) -> Bool[Array, ""]:
        """Whether the constraints hold that depend on others: Newton's corrections ask for as many as are independent."""
        root = jnp.finfo(y[0].dtype).eps ** 0.5
        near = [jnp.all(d <= root * (1 + jnp.max(jnp.abs(x)))) for d, x in zip(self.distances(t, y), y, strict=True)]
        return near[0] & near[1]

    @at_one_instant
    def correction(
        self, t: Time, y: Phase, jacobian: ConstraintJacobian, mu: Float[Array, " c"]
    ) -> tuple[Float[Array, " c"], Any]:
        """One Newton correction of μ in H(t, y + N μ) = 0, and its size: positions first, then the velocities at them.

        The matrix is A M⁻¹Aᵀ at the current point, which differs from the Jacobian A N by the square of the angle
        between the two normal spaces and stays symmetric.
        """
        here = self.displace(y, jacobian, mu)
        change, size = self._corrected(t, here, jacobian, self.jacobian(t, here))
        return mu + change, size

    @at_one_instant
    def _corrected(
        self, t: Time, y: Phase, jacobian: ConstraintJacobian, here: ConstraintJacobian
    ) -> tuple[Float[Array, " c"], Any]:
        """The correction of μ at a point y whose Jacobian is `here`, and its size."""
        q, v = y
        dq, delta = jnp.zeros_like(q), jnp.zeros(0, q.dtype)
        if self.holonomic:
            delta = self.linear.schur_solve(self, here, self.constraint(t, q))
            dq = self.linear.lift(self, jacobian, delta)
        kappa = self.linear.schur_solve(self, here, self.velocity_constraint(t, q - dq, v))
        dv = self.linear.lift(self, jacobian, kappa)
        sizes = self._sizes_of(here, dq, q, self.holonomic), self._sizes_of(here, dv, v, None)
        return -jnp.concatenate([delta, kappa]), tuple(map(jnp.maximum, *sizes))

    def _sizes_of(self, jacobian: ConstraintJacobian, dx: Flat, x: Flat, rows: int | None) -> tuple[Any, Any]:
        """The size of a correction relative to what is in each constraint, which may be small beside other unknowns and beside 1, but
        0 where it is round-off of the largest; and what of it may be round-off, of that or of numbers near 1 in a constraint.
        """
        moved, whole = (self.linear.reach(self, jacobian, jnp.abs(s))[:rows] for s in (dx, x))
        part = jnp.max(moved / jnp.where(moved > 0, moved + whole, 1), initial=0)
        negligible = jnp.max(jnp.abs(dx), initial=0) <= roundoff(x.dtype) * jnp.max(jnp.abs(x), initial=0)
        return jnp.where(negligible, 0, part), jnp.minimum(part, NEAR_1 * relative_change(dx, x))


def _manifold_residual(mu: Float[Array, " c"], params: PyTree) -> Float[Array, " c"]:
    ode, t, y, jacobian, _ = params
    return jnp.concatenate(ode.invariants(t, ode.displace(y, jacobian, mu)))


def _manifold_jacobian(mu: Float[Array, " c"], params: PyTree) -> tuple[Float[Array, "c c"], Float[Array, " c"] | None]:
    """That of `_manifold_residual`; where constraints depend on others, which of them are solved."""
    ode, _, _, jacobian, _ = params
    matrix = jax.jacfwd(_manifold_residual)(mu, params)
    if ode.rank is None:
        return matrix, None
    kept = ode.linear.independent(jacobian)
    return matrix, jnp.concatenate([kept[: ode.holonomic], kept])


def _on_rows(
    system: tuple[Float[Array, "c c"], Float[Array, " c"] | None], b: Float[Array, " c"]
) -> Float[Array, " c"]:
    matrix, kept = system
    return solve(matrix, b) if kept is None else solve(of_rows(matrix, kept), kept * b)


def _outline(function: Callable[..., Any] | None, *args: PyTree) -> tuple[int, bool]:
    """How many numbers `function` returns, and whether it uses its first argument, time."""
    if function is None:
        return 0, False
    time, *rest = args
    arrays, static = eqx.partition(rest, eqx.is_array_like)
    jaxpr, out = jax.make_jaxpr(lambda t, a: function(t, *eqx.combine(a, static)), return_shape=True)(time, arrays)
    variable = jaxpr.jaxpr.invars[0]
    used = any(variable is v for eqn in jaxpr.jaxpr.eqns for v in eqn.invars) or variable in jaxpr.jaxpr.outvars
    return int(sum(np.prod(o.shape) for o in jax.tree.leaves(out))), used


def _transposed(a: Float[Array, "c n"]) -> Callable[[Flat], Array]:
    return lambda along: jnp.sum(along[:, None] * a[: along.size], 0)


def _transposed_jacobian(function: Callable[[Flat], Array], at: Flat) -> Callable[[Flat], Array]:
    """l ↦ lᵀ ∂f/∂x, in reverse where the function has such derivatives."""
    try:
        value, pull_back = jax.vjp(function, at)
        # A loop says so only then.
        jax.eval_shape(pull_back, value)
    except ValueError as error:
        if not (lacks_reverse_derivatives(error) or is_a_loop_without_reverse(error)):
            raise
        return _transposed(jax.jacfwd(function)(at))
    return lambda along: pull_back(along)[0]
