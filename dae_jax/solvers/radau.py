"""Radau IIA with three, five and seven stages for 0 = F(t, y, ẏ)."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..equations.manifold_ode import constant
from ..linalg import implicit_root
from ..types import BoolLike, Time
from .felt import felt
from .manifold import time_sign
from .radau_coefficients import coefficients
from .radau_error import embedded, error_of_step
from .radau_step import CollocationPolynomial, Step, along, coupled, linear_solve
from .replay import Replayable
from .residual_steps import (
    ALIKE,
    SAFETY,
    AbstractResidualSolver,
    Iteration,
    Newton,
    Tolerances,
    Work,
    at_min_step,
    corrected,
    goes_on,
    not_begun,
    of_step,
    passes_a_kink,
    simplified_newton,
    start_of,
    tolerances,
)


# As equinox has it.
if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


# The Jacobian is kept for the next step while Newton's method contracts faster than this.
FAST = 1e-2
# As many more corrections for each stage more than three (the program RADAU).
CORRECTIONS_PER_STAGE = 2.5
# By which diffrax lets a step grow at most.
GROWTH = 10
# Where a factorisation takes as long as many steps, a step that could grow by no more than this keeps its size (the program
# RADAU5).
WORTHWHILE = 1.2
# A step in which Newton's method contracts by less than FAST may grow by no more than CAREFUL, and not at all where by less than SLOW: with
# many stages, which take the Jacobian of one, θ grows like h³, and every other step would fail. In few levels, as θ is often the
# quotient of what is round-off.
SLOW, CAREFUL = 0.1, 1.5


class RadauState(NamedTuple):
    """What a step leaves to the next.

    `z`, `h`: stages and size of the last step, h = 0 before the first; `ydot`: ẏ at its end; `jacobians`, `factors`
    (for the size `factored`); `refresh`: whether the Jacobians are to be evaluated anew; `eta`: θ/(1 − θ) of Newton's
    method; `work`: what has been done.
    """

    z: Float[Array, "s n"]
    h: Float[Array, ""]
    ydot: Float[Array, " n"]
    jacobians: Any
    factors: Any
    factored: Float[Array, ""]
    refresh: Bool[Array, ""]
    eta: Float[Array, ""]
    work: Work


class AbstractRadauIIA(Replayable, AbstractResidualSolver):
    """The Radau IIA method with `stages` stages."""

    stages: AbstractClassVar[int]

    highest_index = 3
    default_index = 2
    interpolation_cls = CollocationPolynomial

    dense: bool = True

    @property
    def kept(self) -> int:
        return self.stages + 1

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return 2 * self.stages - 1

    def error_order(self, terms: diffrax.AbstractTerm) -> int:
        return self.stages + 1

    def fitted_tolerances(self, dtype: Any) -> Tolerances:
        """Those of the controller, with patience for the number of stages."""
        tol = tolerances(self.rtol, self.atol, dtype)
        return tol._replace(corrections=tol.corrections + int(CORRECTIONS_PER_STAGE * (self.stages - 3)))

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> RadauState:
        sign = time_sign(terms, t0, t1)
        zero = jnp.zeros((), y0.dtype)
        step = Step(coefficients(self.stages), args.solved_by(self.linear_solver), sign, t0, t1, y0)
        tol = self.fitted_tolerances(y0.dtype)
        unused = jax.eval_shape(lambda: (j := step.jacobians(t0, y0, y0), step.factor(j, tol)))
        jacobians, factors = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), unused)
        return RadauState(
            jnp.zeros((self.stages, y0.size), y0.dtype),
            zero,
            args.start,
            jacobians,
            factors,
            zero,
            jnp.asarray(True),
            zero + 1,
            Work.none(),
        )

    def invalidate_jacobian(self, state: RadauState) -> RadauState:
        return state._replace(refresh=jnp.ones_like(state.refresh))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: RadauState,
        made_jump: BoolLike,
    ) -> Any:
        state = solver_state._replace(
            refresh=solver_state.refresh | made_jump, h=jnp.where(made_jump, 0, solver_state.h)
        )
        linearised = args.solved_by(self.linear_solver)
        step = Step(coefficients(self.stages), linearised, time_sign(terms, t0, t1), t0, t1, y0)
        tol = self.fitted_tolerances(y0.dtype).waiting(args.patient)
        z, (newton, jacobians, factors, work) = _stages(lambda params: _solve(*params), (step, constant(state), tol))
        y1 = y0 + z[-1]
        counted = error_of_step(*constant((step, factors.real, z, state)), tol=tol, dense=self.dense)
        if args.felt is not None:
            seen = constant(
                felt(embedded(step, constant(factors.real), z, tol)[1], y0, y1, step.h >= args.felt, tol.rtol, tol.atol)
            )
            counted = jnp.where(jnp.abs(seen) > jnp.abs(counted), seen, counted)
        ydot, smallest = step.stages(z)[-1][2], step.smallest
        # What is algebraic may jump in the smallest step.
        bend = constant((ydot - state.ydot) * (step.h / 2)) * args.structure.differential
        scaled = jnp.where(smallest, bend, counted)
        error = constant(tol.norm(scaled, y0, y1))
        failure = of_step(newton.converged, factors.probe.determined, error)
        scaled = scaled * self._held(linearised, error, newton)
        y1, scaled, result = at_min_step(failure, t0, t1, y0, y1, scaled)
        slow = (newton.theta > FAST) & (newton.count > 1)
        # What jumped says nothing of the next step.
        size = jnp.where(smallest, 0, step.h)
        new = RadauState(z, size, ydot, jacobians, factors, size, slow, newton.eta, work)
        return y1, scaled, {"y0": y0, "z": z}, constant(new), result

    def _held(self, linearised: Any, error: Any, newton: Newton) -> Any:
        """By what to multiply an error from which a larger size would follow than Newton's method goes with, or one that is not worth
        new factors.
        """
        order = self.stages + 1
        size = lambda growth: (SAFETY / growth) ** order
        theta = jnp.where(newton.count > 1, newton.theta, 0)
        least = jnp.where(theta > SLOW, size(1), jnp.where(theta > FAST, size(CAREFUL), 0))
        held = jnp.where((error > 0) & (error < least), least / error, 1)
        if not linearised.storage.dear:
            return held
        unworthy = (error * held <= size(1)) & (error * held >= size(WORTHWHILE))
        return jnp.where(unworthy, size(1) / error, held)

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> Any:
        linearised = args.solved_by(self.linear_solver)
        step = Step(coefficients(self.stages), linearised, time_sign(terms, t0, t1), t0, t1, y0)
        z, _ = _stages(lambda params: (params[1], ()), (step, constant(dense["z"])))
        return y0 + z[-1], history, {"y0": y0, "z": z}


def _stages(iterate: Callable[[Any], Any], params: Any) -> tuple[Float[Array, "s n"], Any]:
    """The stages zᵢ, and how they were found, with their derivative; `params` holds the `Step` first."""
    # The unknowns of a stage are interleaved, so that a band stays one.
    count = len(params[0].method.nodes)
    apart, together = lambda z: z.reshape(-1, count).T, lambda z: z.T.reshape(-1)

    def found(params: Any) -> Any:
        z, how = iterate(params)
        return together(z), how

    flat, how = implicit_root(
        lambda z, params: together(params[0].residuals(apart(z))),
        found,
        params,
        linear_solve=linear_solve,
        jacobian=lambda z, params: coupled(params[0], apart(z)),
    )
    return apart(flat), how


class RadauIIA5(AbstractRadauIIA):
    """The Radau IIA method with three stages: order 5, stiffly accurate, L-stable, for 0 = F(t, y, ẏ) of index 0 to 3.

        0 = F(t₀ + cᵢ h, Yᵢ, Kᵢ),   Yᵢ = y₀ + h Σ aᵢⱼ Kⱼ,   y₁ = Y₃.

    Simplified Newton on zᵢ = Yᵢ − y₀, decoupled into a real and a complex system; the Jacobians and their factors are kept
    while they serve. The error estimate is that of the embedded formula of order 3, filtered by (γ/h ∂F/∂ẏ + ∂F/∂y)⁻¹;
    errors of variables of index k count with h^(k−1). Orders: 5 for ODEs and index 1; for index 2, 5 for the
    differential variables and 3 for the algebraic ones; for index 3, 5, 3 and 2 for variables of index 1, 2 and 3.
    Constraints of the form hold at the end of each step to the tolerance of Newton's method. Algebraic variables may jump
    with a source or where they switch: the smallest step that time resolves is one of the implicit Euler method, in which
    each correction has a Jacobian of its own, and the error of differential variables alone counts.

    That estimate does not know how an algebraic variable moves within a step, nor what comes of it for variables of index 2
    and higher, which follow from derivatives. The error of the polynomial through the step's points counts too, for all
    variables of the user where values between steps are wanted (`dense`), for those of index 2 and higher always: the fourth
    divided difference of the points and the start of the step before, at the largest value of its polynomial; in a first
    step the third, without the start. So it does for variables of the user that the filter alone has made small: where a
    component of the estimate is above the tolerance and that from y₀ + error, which RADAU5 takes after a failed step, below.
    It is so for a stiff component, and for what follows from a derivative in the limit only: a current through a small
    resistor onto a capacitor, a velocity of a small mass.

    **Arguments**

    - `dense`: whether values between steps are wanted (`daesolve` sets it as `saveat` and `event` need it).

    - `rtol`, `atol`: the tolerances that Newton's method is fitted to; by default those of the step-size controller, and
      round-off for fixed steps.
    - `linear_solver`: a `GMRES(...)` for systems that are too large for factors.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, sections IV.8 and VII.4 and the program
    RADAU5; E. Hairer, C. Lubich, M. Roche, *The Numerical Solution of Differential-Algebraic Systems by Runge–Kutta
    Methods*, table 2.3, for the orders.
    """

    stages: ClassVar[int] = 3


class RadauIIA9(AbstractRadauIIA):
    """The Radau IIA method with five stages, for tight tolerances: order 9, otherwise as `RadauIIA5`.

    A real and two complex systems for each correction; the embedded formula has order 5. Orders: 9 for ODEs and index 1; for
    index 2, 9 for the differential variables and 5 for the algebraic ones; for index 3, 9, 5 and 4 for variables of index 1,
    2 and 3. Between the ends of a step the error is of order 6, where values there are wanted.

    **Arguments**

    - `dense`, `rtol`, `atol`, `linear_solver`: as for `RadauIIA5`.

    Source: E. Hairer, G. Wanner, *Stiff differential equations solved by Radau methods*, J. Comput. Appl. Math. 111 (1999), and
    the program RADAU.
    """

    stages: ClassVar[int] = 5


class RadauIIA13(AbstractRadauIIA):
    """The Radau IIA method with seven stages, for the tightest tolerances: order 13, otherwise as `RadauIIA5`.

    A real and three complex systems for each correction; the embedded formula has order 7. Orders: 13 for ODEs and index 1;
    for index 2, 13 for the differential variables and 7 for the algebraic ones; for index 3, 13, 7 and 6 for variables of
    index 1, 2 and 3. Between the ends of a step the error is of order 8, where values there are wanted.

    **Arguments**

    - `dense`, `rtol`, `atol`, `linear_solver`: as for `RadauIIA5`.

    Source: as for `RadauIIA9`.
    """

    stages: ClassVar[int] = 7


def _predicted(step: Step, state: RadauState) -> Float[Array, "s n"]:
    """The stages on the last step's polynomial, where it does not reach on its tangent; 0 without one."""
    method = step.method
    ratio = step.h / jnp.where(state.h == 0, 1, state.h)
    ahead = jnp.stack([along(state.z, 1 + float(c) * ratio) - state.z[-1] for c in method.nodes])
    if method.reach < GROWTH:
        tangent = jnp.stack([float(c) * step.h * step.sign * state.ydot for c in method.nodes])
        ahead = jnp.where(ratio > method.reach, tangent, ahead)
    return jnp.where(state.h == 0, 0, ahead)


def _solve(step: Step, state: RadauState, tol: Tolerances) -> Any:
    """The stages, and how they were found: with the Jacobian at hand first, with new ones where these fail, and in the
    smallest step with new ones for each correction.
    """
    h, smallest = step.h, step.smallest
    predicted = jnp.where(smallest, 0, _predicted(step, state))
    weights, differential = step.linearised.weights(h, tol.raised()), step.linearised.structure.differential
    pace = step.linearised.weights(h) / tol.scale(step.y0) if step.linearised.followed.any() else None

    def attempt(carry: Any) -> Any:
        tries, fresh, before, _, jacobians, factors, work = carry
        renew = (tries > 0) | state.refresh | smallest
        start = start_of(tries, jnp.where(tries == 0, predicted, 0), before)
        at_end = smallest | before.converged
        t, y = jnp.where(at_end, step.t1, step.t0), jnp.where(at_end, step.y0 + start[-1], step.y0)
        evaluate = lambda: step.jacobians(step.sign * t, y, state.ydot)
        jacobians = lax.cond(renew, evaluate, lambda: jacobians)
        refactor = renew | (jnp.abs(h - state.factored) > ALIKE * h)
        factors = lax.cond(refactor, lambda: step.factor(jacobians, tol), lambda: factors)
        correction = lambda residuals: step.correction(factors, residuals)
        combined = lambda rows: jnp.stack([step.linearised.combined(row, 1 / h) for row in rows])
        iteration = Iteration(step.residuals, correction, combined, factors.round_off, factors.enough)
        scale = lambda z: weights / tol.scale(step.y0, step.y0 + z[-1])
        # Here, since each function would have it.
        off = iteration.residual(start)
        newton = lax.cond(
            smallest & (tries > 0),
            lambda: corrected(iteration, start, off, tries, scale, differential, state.eta, tol),
            lambda: simplified_newton(iteration, start, off, weights / tol.scale(step.y0), state.eta, tol, pace),
        )
        work = work.and_of(renew, refactor, newton.count)
        seen = before.converged | step.determines(factors, newton.x)
        return tries + 1, fresh | renew, newton, seen, jacobians, factors, work

    def again(carry: Any) -> Any:
        tries, fresh, newton, seen, *_ = carry
        return goes_on(tries, newton.converged, seen, fresh, smallest)

    none, no = not_begun(predicted, state.eta), jnp.asarray(False)
    first = (0, no, none, no, state.jacobians, state.factors, state.work)
    _, _, newton, _, jacobians, factors, work = lax.while_loop(again, attempt, first)
    passes = passes_a_kink(newton, smallest, state.h != 0)
    z = jnp.where(passes & ~differential, 0, newton.x)
    found = newton._replace(x=None, converged=newton.converged | passes)
    return z, (found, jacobians, factors, work)
