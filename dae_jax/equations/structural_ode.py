"""The underlying ODE of any system 0 = F(t, y, ẏ), from the offsets of its structural analysis."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..linalg import (
    Tearing,
    amplified_roundoff,
    fixed_point,
    implicit_root,
    relative_change,
    row_products,
    semidefinite_solve,
    signed_log_determinant,
    solve,
    solve_contraction,
    take,
    tearing,
    while_progress,
)
from ..structure import Block, block_triangular, interpreted
from ..systems import System, is_mechanism
from ..types import Args, DType, Flat, State, Time
from .constraint_jacobian import Rank
from .derivative_orders import Combination, derivative_of, find_offsets
from .initial_rates import is_nonlinear, rates_of
from .manifold_ode import Feedback, ManifoldODE, at_one_instant, constant
from .mechanical import MechanicalODE
from .nearest_point import SHORTEST, finite_start, nearest_point
from .nearest_step import step_to
from .orders import Orders
from .probe import Probe
from .residual_form import LARGE, ResidualForm
from .sparse_invariants import FREE, SparseInvariants
from .state_selection import lasting
from .taylor import total_derivatives


# Gauss–Newton's method for what is left of H at the initial state.
STARTING = 100
# The rows of the Jacobian are a chart's directions while less than this part of one turns in a step.
TURNS = 0.05
# With more equations, or constraints, a determinant takes longer than a step.
ORIENTED = 32
# What of H may be round-off, in parts of its terms and of the resolution of numbers.
OFF = 1000


class StructuralODE(ManifoldODE):
    """From the offsets c of the equations and d of the variables (Pryce's Σ-method): the equations Fᵢ^(Cᵢ) = 0 are linear
    in the derivatives X of order Dⱼ and give these, the state Y holds the lower ones, and

        H = (Fᵢ^(k), k < Cᵢ) = 0

    are the invariants: the constraints and the hidden ones. C = c and D = d where Fᵢ^(cᵢ) is linear in X; else, and where
    a derivative of order 0 would have to be found from a nonlinear equation, each is differentiated once more. Where
    highest derivatives cancel between equations, F stands for their `combination`.

    Source: J. D. Pryce, BIT 41 (2001), 364–394.
    """

    form: ResidualForm
    combination: Combination = eqx.field(static=True)
    orders: Orders = eqx.field(static=True)
    tearing: Tearing = eqx.field(static=True)
    sparse: SparseInvariants | None = eqx.field(static=True, default=None)
    # The blocks of the matrix of the equations for X, rows and columns, that depend on anything.
    varying: tuple[Block, ...] = eqx.field(static=True, default=())
    # The square of what counts as one along each entry of Y; all count alike where it is not known.
    metric: Float[Array, " N"] | None = None

    @classmethod
    def of(cls, form: ResidualForm, dtype: DType, complete: int = 0) -> "StructuralODE":
        """Finds the offsets while tracing. `complete`: so many times more than needed; with one all variables are in the state and all
        that restricts them is among the invariants.

        Errors: `ValueError` for a structurally singular system.
        """
        found = find_offsets(form, dtype)
        offsets = found.sigma.equation_offsets, found.sigma.variable_offsets

        def differentiated(more: int) -> "StructuralODE":
            return cls(form, found.combination, Orders(*(tuple(k + more for k in c) for c in offsets)), Tearing())

        if complete:
            ode = differentiated(complete)
            sparse = SparseInvariants.of(ode, found.occurrence) if form.size > LARGE else None
            return dataclasses.replace(ode, sparse=sparse)
        ode = differentiated(0)
        linear, known = ode._coefficients(dtype) if max(found.sigma.variable_offsets) else (False, np.zeros(0))
        if not linear:
            ode = differentiated(1)
            _, known = ode._coefficients(dtype)
        present = np.zeros_like(known, bool)
        for i, variables in enumerate(found.pattern):
            present[i, variables] = True
        known = np.where(present, known, 0)
        blocks = block_triangular(found.pattern, found.sigma.transversal)
        varying = tuple(block for block in blocks if np.isnan(known[np.ix_(*block)]).any())
        return dataclasses.replace(ode, tearing=tearing(known), varying=varying)

    def _coefficients(self, dtype: DType) -> tuple[bool, Float[np.ndarray, "n n"]]:
        """Whether the highest derivatives enter linearly, that is whether their coefficients do not depend on them, and
        which of these are numbers.
        """
        time, state, y = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (self.orders.size,), (self.form.size,)))

        def coefficients(t: Any, s: Any, x: Any) -> Any:
            twice = lambda x: (value := self.of_highest_order(t, s, x), value)
            return jax.jacfwd(twice, has_aux=True)(x)

        found = interpreted(coefficients, time, state, y)
        n = self.form.size
        linear = not (found.on[2][: n * n].nnz or found.jumps[2].nnz)
        return linear, found.numbers[: n * n].reshape(n, n)

    # The equations and their derivatives

    @property
    def equations(self) -> tuple[str, ...]:
        """A name for each equation."""
        return self.combination.names(self.form.equations)

    def levels(self, t: Time, y: Float[Array, " N"], x: Float[Array, " n"], count: int) -> list[Float[Array, " n"]]:
        """F, dF/dt, … at (Y, X): `count` of them, each right in the equations of which only Y and X are needed."""
        both = jnp.concatenate([y, x])
        orders = [take(both, place) for place in self.orders.places]
        more = count + self.combination.degree
        return self.combination.of(total_derivatives(self.form.residual, jnp.asarray(t, y.dtype), orders, more))

    def of_highest_order(self, t: Time, y: Float[Array, " N"], x: Flat) -> Float[Array, " n"]:
        """Fᵢ^(Cᵢ)."""
        return self.highest_of(self.levels(t, y, x, max(self.orders.equations) + 1))

    def highest_of(self, levels: list[Float[Array, " n"]]) -> Float[Array, " n"]:
        """Fᵢ^(Cᵢ) of all the derivatives of F."""
        n = self.form.size
        return take(jnp.concatenate(levels), n * np.array(self.orders.equations) + np.arange(n))

    @at_one_instant
    def _system(
        self, t: Time, y: Float[Array, " N"], feedback: Feedback | None
    ) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
        """The matrix and the right-hand side of the equations for X."""
        zero = jnp.zeros(self.form.size, y.dtype)
        right = -self.of_highest_order(t, y, zero)
        if feedback is not None and any(self.orders.equations):
            levels = self.levels(t, y, zero, max(self.orders.equations, default=0))
            terms = [
                feedback(*(levels[k][i] for k in range(c))) if c else 0 for i, c in enumerate(self.orders.equations)
            ]
            right = right - jnp.stack([jnp.asarray(term, y.dtype) for term in terms])
        return jax.jacfwd(lambda x: self.of_highest_order(t, y, x))(zero), right

    def highest(self, t: Time, y: Float[Array, " N"], feedback: Feedback | None = None) -> Float[Array, " n"]:
        """X, the derivatives of order Dⱼ."""
        return self.tearing.solve(*self._system(t, y, feedback))

    def leading(self, t: Time, y: Float[Array, " N"]) -> Float[Array, "n n"]:
        """The matrix of the equations for X, without a derivative."""
        return lax.stop_gradient(self._system(t, y, None)[0])

    @property
    def oriented(self) -> list[Block]:
        """The varying blocks of the matrix of the equations for X, but for large ones."""
        return [block for block in self.varying if len(block.equations) <= ORIENTED]

    @at_one_instant
    def determines_highest(self, t: Time, y: Float[Array, " N"]) -> tuple[Bool[Array, ""], Float[Array, "2 blocks"]]:
        """Whether the equations for X determine all of it, to round-off, and of the determinant of each `oriented` block the sign and
        log |det|.
        """
        matrix = self.leading(t, y)
        apply = lambda x: jnp.sum(matrix * x, 1)
        probe = Probe.of(apply, lambda b: self.tearing.solve(matrix, b), jnp.ones(self.form.size, y.dtype))
        found = [jnp.stack(signed_log_determinant(matrix[np.ix_(*block)])) for block in self.oriented]
        return probe.determined, jnp.stack(found, 1) if found else jnp.zeros((2, 0), y.dtype)

    # The underlying ODE and the manifold

    def field(self, t: Time, y: Float[Array, " N"], feedback: Feedback | None = None) -> Any:
        both = jnp.concatenate([y, self.highest(t, y, feedback)])
        return take(both, self.orders.derivatives)

    @at_one_instant
    def invariants(self, t: Time, y: Float[Array, " N"]) -> tuple[Float[Array, " levels"], ...]:
        highest = max(self.orders.equations)
        if not highest:
            return (jnp.zeros(0, y.dtype),)
        levels = self.levels(t, y, jnp.zeros(self.form.size, y.dtype), highest)
        return tuple(take(level, self.orders.rows(k)) for k, level in enumerate(levels))

    @property
    def invariant_names(self) -> tuple[str, ...]:
        """A name for each invariant."""
        names = self.equations
        return tuple(derivative_of(names[i], k) for k in range(max(self.orders.equations)) for i in self.orders.rows(k))

    def violations(self, t: Time, y: Float[Array, " N"]) -> Float[Array, " m"]:
        """H(t, Y), all levels."""
        return jnp.concatenate(self.invariants(t, y))

    @at_one_instant
    def jacobian(self, t: Time, y: Float[Array, " N"]) -> Float[Array, "m N"]:
        """∂H/∂Y, whose rows, times the `metric`, are normal to the manifold in it."""
        return jax.jacfwd(self.violations, 1)(t, y)

    def lasting_jacobian(
        self, t0: Time, y0: Float[Array, " N"], t1: Time, ahead: Float[Array, " N"]
    ) -> Float[Array, "m N"]:
        """The Jacobian, or, where a row of it leads away from the manifold within some such steps, as with units that are far apart, their
        entries that last.
        """
        here = self.jacobian(t0, y0)
        if not len(here):
            return here
        there = lax.stop_gradient(self.jacobian(t1, ahead))
        moves = self._moves(here)
        along = jnp.abs(jnp.sum((there - here) * moves, 1)) / jnp.sum(here * moves, 1)
        return jnp.where(jnp.any(along > TURNS), lasting(here, there), here)

    def overflows(self, t: Time, y: Float[Array, " N"]) -> Bool[Array, " N"]:
        """The entries of Y by which a derivative of H is not finite."""
        if self.sparse is None:
            return ~jnp.all(jnp.isfinite(self.jacobian(t, y)), 0)
        finite = jnp.isfinite(self.sparse.entries(self, t, y)).astype(y.dtype)
        return jax.ops.segment_min(finite, self.sparse.columns, y.size) < 1

    def sizes(self, t: Time, y: Float[Array, " N"], of: tuple[Float[Array, " N"], ...]) -> list[Float[Array, " m"]]:
        """Σ |∂H/∂Y| s of each invariant, for each s in `of`."""
        if self.sparse is not None:
            entries = jnp.abs(self.sparse.entries(self, t, y))
            return [self.sparse.row_sums(entries * s[self.sparse.columns]) for s in of]
        entries = jnp.abs(self.jacobian(t, y))
        return [jnp.sum(entries * s, 1) for s in of]

    def tangent(self, dy: Float[Array, " N"], jacobian: Float[Array, "m N"]) -> Any:
        if not len(jacobian):
            return dy
        schur = row_products(jacobian, self._moves(jacobian))
        return dy - self.displace(0, jacobian, semidefinite_solve(schur, jnp.sum(jacobian * dy, 1)))

    def displace(self, y: Float[Array, " N"] | float, jacobian: Float[Array, "m N"], mu: Float[Array, " m"]) -> Any:
        return y + jnp.sum(self._moves(jacobian) * mu[:, None], 0)

    def _moves(self, jacobian: Float[Array, "m N"]) -> Float[Array, "m N"]:
        """What leads along the rows of the Jacobian."""
        return jacobian if self.metric is None else jacobian * self.metric

    def retract_along(
        self, t: Time, y: Float[Array, " N"], jacobian: Float[Array, "m N"], bend: float | None = None
    ) -> tuple[Any, Bool[Array, ""]]:
        """`bend`: found only if Newton's first correction misses no more than this part of the way, as it does where
        another root is as near.
        """
        if not len(jacobian):
            return y, jnp.asarray(True)
        noise, amplified = OFF * float(jnp.finfo(y.dtype).eps), amplified_roundoff(y.dtype)

        def iterate(params: PyTree) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
            ode, t, y, jacobian = params

            def correct(mu: Float[Array, " m"]) -> tuple[Any, Any]:
                here = ode.displace(y, jacobian, mu)
                off, across = ode.violations(t, here), ode.jacobian(t, here)
                delta = solve(row_products(across, ode._moves(jacobian)), off)
                size = relative_change(ode.displace(0, jacobian, delta), here)
                settled = jnp.all(jnp.abs(off) <= noise * row_products(jnp.abs(across), jnp.abs(here)[None])[:, 0])
                return mu - delta, jnp.where(settled & (size < amplified), 0, size)

            start = jnp.zeros(len(jacobian), y.dtype)
            if bend is None:
                return fixed_point(correct, start)

            def also_first(both: tuple[Float[Array, " m"], Float[Array, " m"]]) -> tuple[Any, Any]:
                (mu, size), first = correct(both[0]), both[1]
                return (mu, jnp.where(jnp.any(first != 0), first, mu)), size

            (mu, first), found = fixed_point(also_first, (start, start))
            length = lambda mu: jnp.max(jnp.abs(ode.displace(0, jacobian, mu)))
            return mu, found & (length(mu - first) <= bend * length(mu) + amplified)

        residual = lambda mu, params: params[0].violations(params[1], params[0].displace(params[2], params[3], mu))
        mu, found = implicit_root(residual, iterate, (self, t, y, jacobian))
        return self.displace(y, jacobian, mu), found

    # The user's state

    def decode(self, t: Time, y: Float[Array, " N"]) -> Any:
        count = self.form.layout.size
        algebraic = 0 in self.orders.variables[:count]
        both = jnp.concatenate([y, self.highest(t, y)]) if algebraic else y
        return self.form.decode(t, take(both, self.orders.places[0][:count]))

    def tolerances(self, t: Time, y: Float[Array, " N"], each: State, absolute: bool) -> Float[Array, " N"]:
        """A tolerance for each number of y, of one for `each` of the state."""
        return self.derivatives_tolerances(t, self.decode(t, y), each, absolute)[0]

    def derivatives_tolerances(
        self, t: Time, state: State, each: State, absolute: bool
    ) -> tuple[Float[Array, " N"], Float[Array, " n"]]:
        """Those of Y and of the derivatives of order Dⱼ."""
        scale = self.form.time_scale(t, state, each) if absolute else None
        return self.orders.of_derivatives(self.form.tolerances(t, state, each, absolute), scale)

    def measured_in(self, t: Time, y: Float[Array, " N"], lengths: Float[Array, " N"]) -> "StructuralODE":
        parts, eps = lengths / jnp.max(lengths), float(jnp.finfo(lengths.dtype).eps)
        # Beside what need not be right at all, others stay; their squares are numbers all the same.
        return dataclasses.replace(self, metric=jnp.where(parts > eps, parts, eps) ** 2)

    def encode(self, t: Time, state: State) -> Float[Array, " N"]:
        """Y of a state: the derivatives of order 1 and higher are those with which the equations hold, or nearly hold."""
        return self.start(t, self.form.encode(state), None)

    def start(
        self,
        t: Time,
        values: Float[Array, " n"],
        freedom: Float[Array, " n"] | None,
        ydot: Float[Array, " n"] | None = None,
        counted: Bool[Array, " n"] | None = None,
        near: bool = False,
    ) -> Float[Array, " N"]:
        """Y near the values of the variables, each of which may move as much as its `freedom` says (0: not at all; 1: no
        more than the others; `None`: none moves), with the least H; those that are not `counted` (`None`: all are) move for nothing.
        Gauss–Newton's method; the derivatives from 0, the first ones from what is known of them or, where F is nonlinear in them, from
        such as satisfy it; these are `ydot` where that is given. `near`: from values that are consistent but for changes that derivatives
        are by.
        """
        index, dtype = self.orders.values, values.dtype
        moves = take(jnp.zeros_like(values) if freedom is None else freedom.astype(dtype), index)
        counts = take(jnp.ones_like(values) if counted is None else counted.astype(dtype), index)
        weights = jnp.where(counts > 0, moves, jnp.where(jnp.asarray(index < 0) | (moves > 0), FREE, 0))
        known = take(values, index)
        first = self.orders.first_derivatives
        if ydot is not None:
            weights = jnp.where(first < 0, weights, 0)
        elif is_nonlinear(self.form, values.dtype):
            ydot = rates_of(self.form, t, values)[0]
        else:
            ydot = self.form.known_ydot(values)
        known = known + take(ydot, first)
        return _nearest(self, t, known, weights, counts, freedom is not None and not near)


def _nearest(
    ode: StructuralODE,
    t: Time,
    known: Float[Array, " N"],
    weights: Float[Array, " N"],
    counts: Float[Array, " N"],
    values_move: bool,
) -> Any:
    if not any(ode.orders.equations):
        return known

    def moved(y: Float[Array, " N"], aim: Float[Array, " N"], params: PyTree) -> Any:
        """The point next to `aim` on the linearisation of H = 0 at y."""
        ode, t, _, weights, counts, *_ = params
        if ode.sparse is not None:
            return ode.sparse.nearest(ode, t, y, aim, weights, counts == 0)
        a, h = ode.jacobian(t, y), ode.violations(t, y)
        return aim + step_to(a, h + jnp.sum(a * (aim - y), 1), weights, counts == 0)

    def settled(y: Float[Array, " N"], aims: Callable[[Array], Array], params: PyTree, damped: bool = False) -> Any:
        ode, t = params[:2]

        def correct(y: Float[Array, " N"]) -> Any:
            way = moved(y, aims(y), params) - y
            return y + (_damped(ode, t, y, way) if damped else 1) * way, relative_change(way, y)

        return while_progress(correct, y, lambda y: ode.violations(t, y), STARTING)

    given = ode, t, known, weights, counts
    held = constant(given)
    start, measured = held[2], (held[4] > 0) & (held[3] > 0)
    # Derivatives have nothing to be near to but what the equations make of them.
    aims = lambda y: jnp.where(held[4] > 0, start, y)
    begin = start
    if values_move:
        overflows = held[0].overflows(held[1], start)
        begin = finite_start(lambda y: held[0].violations(held[1], y), start, (held[3] > 0) & overflows)
    if not values_move:
        first = start
    elif ode.sparse is not None:
        # Solved in parts as small as round-off, a large linearisation does not say how far off a point is.
        first, _ = settled(begin, aims, held, damped=True)
    else:
        scale = jnp.where(measured, 1 / jnp.where(measured, weights, 1), 0)
        inner = lambda a, b: jnp.sum(scale * a * scale * b)
        first = nearest_point(lambda y, aim: moved(y, aim, held), start, aims, inner, measured, begin=begin)
    params = (*given, first)
    # A little of a pull keeps the derivatives that the equations leave open from being undetermined.
    pull = jnp.finfo(known.dtype).eps ** 0.6
    aim = lambda y, params: jnp.where(params[4] > 0, params[2], y - pull * (y - params[5]))
    # From the nearest point on, what `cut` has left of H there.
    iterate = lambda params: settled(params[5], lambda y: y, params)
    off = lambda y, p: y - moved(y, aim(y, p), p)
    if ode.sparse is None:
        return implicit_root(off, iterate, params)[0]

    def solved(at: tuple[Float[Array, " N"], PyTree], b: Float[Array, " N"]) -> Any:
        y, p = at
        # What was found by substitution is differentiated by it, in products of its sparse factors.
        return solve_contraction(jax.linearize(lambda y: moved(y, aim(y, p), p), y)[1], b)

    return implicit_root(off, iterate, params, linear_solve=solved, jacobian=lambda y, p: (y, p))[0]


def _damped(ode: StructuralODE, t: Time, y: Float[Array, " N"], way: Float[Array, " N"]) -> Any:
    """How much of a correction to go: as much as leaves no more of an equation than it has in terms."""
    assert ode.sparse is not None
    entries, off = jnp.abs(ode.sparse.entries(ode, t, y)), jnp.abs(ode.violations(t, y))
    terms, sizes = (ode.sparse.row_sums(entries * jnp.abs(x)[ode.sparse.columns]) for x in (way, y))
    round_off = OFF * jnp.finfo(y.dtype).eps * sizes
    # A comparison with what is not finite is false.
    is_near = lambda part: jnp.all(jnp.abs(ode.violations(t, y + part * way)) <= 2 * (off + part * terms) + round_off)
    return lax.while_loop(lambda part: ~is_near(part) & (part > SHORTEST), lambda part: part / 2, jnp.ones((), y.dtype))


def underlying_ode(
    system: System, t: Time, state: State, args: Args, rank: int | Rank | None = None
) -> tuple[Any, ManifoldODE]:
    """The state and the underlying ODE of any system; a mechanism's is found faster than from the offsets."""
    if is_mechanism(system):
        mechanical = MechanicalODE.of(system, t, state, args, rank)
        return mechanical.encode(state), mechanical
    ode = StructuralODE.of(ResidualForm.of(system, t, state, args), jnp.result_type(*jax.tree.leaves(state)))
    return ode.encode(t, state), ode
