"""Orthogonal projection after each step (Pöll, Hafner and Heinzl, sec. 2.4)."""

import functools
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from ..types import BoolLike, Time
from ..validate.states import brief
from .abilities import is_recomputable
from .explicit import unrolled, with_retraction
from .manifold import AbstractManifoldSolver, or_nan, outcome, time_sign
from .residual_steps import AbstractResidualSolver
from .wrapping import AbstractWrapper


class Projected(NamedTuple):
    """What a step leaves to the next: the inner solver's state, and how far its start may be off the manifold: what a user's may,
    after a step nothing.
    """

    inner: Any
    excused: Any


class OrthogonalProjection(AbstractWrapper, AbstractManifoldSolver):
    """A step of `solver`, then the nearest point with H = 0:

        ỹ = Φ_h(y₀),   y₁ = ỹ + N(ỹ) μ,   H(t₁, y₁) = 0,

    with N = M⁻¹Aᵀ of the constraint Jacobian A, taken at ỹ (which is nearest to within the square of
    the step's error). Positions are projected first, velocities at the new position next. The order of `solver` is
    kept, and so is its stability; a first integral that `solver` keeps may be lost: with explicit Euler the pendulum's
    speed grows. The error of a step is that of `solver`, or N μ where that is more.

    **Arguments**

    - `solver`: any diffrax solver of ODEs.

    Errors: a projection that is not found makes the step end in NaN: an adaptive controller tries a smaller one, a
    fixed step ends the solve.

    Source: E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, IV.4, algorithm 4.2.
    """

    solver: diffrax.AbstractSolver

    def __check_init__(self) -> None:
        keeps = isinstance(self.solver, AbstractManifoldSolver | AbstractResidualSolver)
        if keeps or not isinstance(self.solver, diffrax.AbstractSolver):
            alone = ", which keeps the constraints by itself: use it without OrthogonalProjection" if keeps else ""
            raise ValueError(
                f"OrthogonalProjection takes a solver of ODEs such as diffrax.Tsit5(), but got {brief(self.solver)}{alone}."
            )

    @property
    def recomputable(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return is_recomputable(self.solver)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        eps = max(float(jnp.finfo(x.dtype).eps) for x in jax.tree.leaves(y0))
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(x), initial=0) for x in jax.tree.leaves(y0)]))
        return Projected(unrolled(self.solver).init(terms, t0, t1, y0, args), 2 * eps**0.5 * (1 + largest))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Projected,
        made_jump: BoolLike,
    ) -> Any:
        solver: Any = unrolled(self.solver)
        sign = time_sign(terms, t0, t1)

        def retract(t: Any, y: Any) -> Any:
            return args.project(sign * t, y)

        if hasattr(solver, "step_and_retract"):
            y1, error, dense, inner, found = solver.step_and_retract(
                terms, t0, t1, y0, args, solver_state.inner, made_jump, retract, solver_state.excused
            )
            result = diffrax.RESULTS.successful
        else:
            ahead, error, dense, inner, result = solver.step(terms, t0, t1, y0, args, solver_state.inner, made_jump)
            y1, found = retract(t1, ahead)
            if error is not None:
                counted = functools.partial(with_retraction, excused=solver_state.excused)
                error = jax.tree.map(counted, error, ahead, y1)
        error = None if error is None else or_nan(found, error)
        result = diffrax.RESULTS.where(result == diffrax.RESULTS.successful, outcome(jnp.asarray(found)), result)
        state = Projected(inner, jnp.zeros_like(solver_state.excused))
        return or_nan(found, y1), error, dense, state, result

    def retract(self, t: Any, y: Any, ode: Any) -> Any:
        y, found = ode.project(t, y)
        return or_nan(found, y)
