"""Backward differentiation formulas of order 1 to 5 with variable steps for 0 = F(t, y, ẏ)."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..equations.manifold_ode import constant
from ..linalg import implicit_root, rms_norm
from ..types import BoolLike, Time
from .felt import felt
from .manifold import time_sign
from .replay import Replayable
from .residual_steps import (
    ALIKE,
    SAFETY,
    AbstractResidualSolver,
    Iteration,
    Tolerances,
    Work,
    at_min_step,
    corrected,
    goes_on,
    is_smallest,
    not_begun,
    of_step,
    passes_a_kink,
    simplified_newton,
    start_of,
    tolerances,
    within,
)


MAX_ORDER = 5
ROWS = range(MAX_ORDER + 1)
# Smaller errors, in parts of the tolerance, do not decide on the order while it rises.
SIGNIFICANT = 0.01
# A step that is shorter than was wanted, by more than what is left of an interval is shared out by.
LESS = 0.9
# The step-size controller has h_new = h · SAFETY · error^(−1 / ERROR_ORDER).
ERROR_ORDER = 2


class NewtonPolynomial(diffrax.AbstractLocalInterpolation):
    """Σ φⱼ Πᵢ (t − tₙ₋ᵢ)/ψᵢ₊₁, i < j ≤ k: the polynomial through the last points that the step's formula of this `order` has
    used; the value at the end where algebraic variables have `jumped` in the step. `first`: without a history.
    """

    t0: Any
    t1: Any
    phi: Any
    psi: Any
    order: Any
    jumped: Any
    first: Any

    def evaluate(self, t0: Time, t1: Any = None, left: bool = True) -> Any:
        """The value at `t0`, or the increment from there to `t1`."""
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        psi = jnp.where(self.psi == 0, 1, self.psi)
        used = jnp.where(self.jumped > 0, 0, self.order)
        phi = [jnp.where(j <= used, self.phi[j], 0) for j in ROWS]
        # After a jump in time diffrax asks for a point that is before the step by round-off.
        inside = within(t0, self.t0, self.t1)
        y = phi[MAX_ORDER]
        for j in reversed(range(MAX_ORDER)):
            distance = inside - self.t1 + (self.psi[j - 1] if j else 0)
            y = phi[j] + distance / psi[j] * y
        return y


class _State(NamedTuple):
    """What a step leaves to the next.

    `phi`: modified divided differences φ₁ ... φ₅ at tₙ; `psi`: tₙ − tₙ₋₁, tₙ − tₙ₋₂, ...; `steps`: how many were taken since
    the start or a jump; `order` of the next step; `used`: that of the last; `alike`: how many steps had this size and
    order; `rising`: the order has risen with every step so far; `wanted`: the size that the next step should have, more than
    it has where a step failed between; `held`: the size is not to be doubled yet; `factors` of ∂F/∂y + c ∂F/∂ẏ, and the c
    they were made for; `eta`: θ/(1 − θ) of Newton's method; `work`: what has been done.
    """

    phi: Float[Array, "5 n"]
    psi: Float[Array, " 6"]
    steps: Int[Array, ""]
    order: Int[Array, ""]
    used: Int[Array, ""]
    alike: Int[Array, ""]
    rising: Bool[Array, ""]
    wanted: Float[Array, ""]
    held: Bool[Array, ""]
    factors: Any
    c: Float[Array, ""]
    eta: Float[Array, ""]
    work: Work


class _Factors(NamedTuple):
    """The factors of the iteration `matrix`, what may be `round_off` of each equation, what is `enough`, and its `probe`."""

    matrix: Any
    round_off: Float[Array, " n"]
    enough: Float[Array, " n"]
    probe: Any


class _Step(NamedTuple):
    """The equation of a step, 0 = F(t₁, y, ẏ*+ c (y − y*)): a pytree, so that it can be differentiated."""

    linearised: Any
    sign: Any
    t1: Any
    h: Any
    c: Any
    y: Float[Array, " n"]
    rate: Float[Array, " n"]

    def residual(self, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """F at the new point."""
        return self.linearised.residual(self.sign * self.t1, y, self.sign * (self.rate + self.c * (y - self.y)))

    def factor(self, y: Float[Array, " n"], tol: Tolerances) -> _Factors:
        """The factors of ∂F/∂y + c ∂F/∂ẏ."""
        j, m = self.linearised.jacobians(self.sign * self.t1, y, self.sign * (self.rate + self.c * (y - self.y)))
        factors = self.linearised.factor(j, m, self.sign * self.c, self.h)
        round_off = tol.round_off(self.linearised, j, m, self.c, self.y)
        enough = tol.enough(self.linearised, j, m, self.c, self.y)
        return _Factors(factors, round_off, enough, self.linearised.probe(j, m, factors))


class BDF(Replayable, AbstractResidualSolver):
    """The backward differentiation formulas of order 1 to 5 for 0 = F(t, y, ẏ), of variable step and order.

    The polynomial y* of degree k through the last k + 1 points predicts y and ẏ at t₁; the solution's polynomial goes
    through (t₁, y) and the points of y* at t₁ − h, ..., t₁ − k h, so that

        0 = F(t₁, y, ẏ* + c (y − y*)),   c = (1 + 1/2 + ... + 1/k)/h

    (fixed leading coefficient). Simplified Newton from y*; its matrix is kept while c does not change and it serves. The error is
    estimated by y − y*, also for the orders k − 2, k − 1 and k + 1, from which the next order and step size follow.

    For index 0 to 2, and for index 3 in the GGL form and as "index-2". Variables of index 2 and higher, among them the
    multipliers of these forms, follow from the others and are not in the error test: after a change of order or size
    they are off by O(hᵏ), which would hold the step down and gain nothing. Algebraic variables may jump with a source: the
    smallest step that time resolves counts where the differential variables are accurate, and the history begins anew.

    **Arguments**

    - `dense`: whether values between steps are wanted (`daesolve` sets it as `saveat` and `event` need it): then the user's
      variables of index 2 and higher are in the error test too.
    - `rtol`, `atol`: by default those of the step-size controller, which must not differ.
    - `linear_solver`: a `GMRES(...)` for systems that are too large for factors.

    The step size follows from the order, so it is the solver that finds it, and the error it returns is the one from
    which a `diffrax.PIDController` with its default coefficients finds the same.

    Source: K. E. Brenan, S. L. Campbell, L. R. Petzold, *Numerical Solution of Initial-Value Problems in
    Differential-Algebraic Equations*, chapter 5; A. C. Hindmarsh et al., *SUNDIALS*, ACM Trans. Math. Softw. 31 (2005),
    363–396, for the choice of the order.
    """

    dense: bool = True

    highest_index = 2
    default_index = 1
    interpolation_cls = NewtonPolynomial

    @property
    def kept(self) -> int:
        return len(ROWS)

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return MAX_ORDER

    def error_order(self, terms: diffrax.AbstractTerm) -> int:
        return ERROR_ORDER

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> _State:
        sign = time_sign(terms, t0, t1)
        like = _Step(args.solved_by(self.linear_solver), sign, t1, t1 - t0, 1 / (t1 - t0), y0, y0)
        tol = tolerances(self.rtol, self.atol, y0.dtype)
        factors = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(lambda: like.factor(y0, tol)))
        return _start(sign * args.start, factors, Work.none())

    def invalidate_jacobian(self, state: _State) -> _State:
        return state._replace(c=jnp.zeros_like(state.c))

    def formula(self, state: _State) -> Int[Array, ""]:
        return state.order

    def by_formula(self, state: _State, formula: Int[Array, ""]) -> _State:
        # Without a history there is that of order 1 only.
        return state._replace(order=jnp.where(state.steps == 0, state.order, formula))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: _State,
        made_jump: BoolLike,
    ) -> Any:
        # A lane of a batch that has ended goes on with steps of length 0, whose derivatives are multiplied by 0.
        h = jnp.where(t1 == t0, 1, t1 - t0)
        sign, state = time_sign(terms, t0, t1), solver_state
        if made_jump is not False:
            state = lax.cond(
                made_jump,
                lambda: _start(sign * constant(args.ydot(sign * t0, y0)), state.factors, state.work),
                lambda: state,
            )
        tol = tolerances(self.rtol, self.atol, y0.dtype).waiting(args.patient)
        k, method = state.order, _formula(state.order, state.steps == 0, state.psi, h)
        linearised = args.solved_by(self.linear_solver)
        step, star = _predicted(method, k, state.phi, linearised, sign, t1, h, y0)
        y1, (newton, passes, factors, work) = _point(
            lambda params: _solve(*params), (step, *constant((y0, state, is_smallest(t0, t1))), tol)
        )
        change, phi = _differences(y1 - step.y, star, k)

        scale = args.weights(h) * args.counted(self.dense) / tol.scale(y0, y1)
        seen = lambda row: row if args.felt is None else felt(row, y0, y1, h >= args.felt, tol.rtol, tol.atol)
        size = lambda row: rms_norm(constant(seen(row) * scale))
        sizes = [size(row) for row in phi]
        higher = size(change - _at(star, k + 1))
        alike = jnp.where(method.constant & (k == state.used), state.alike, 0) + 1
        held = (h < LESS * state.wanted) | (state.held & (alike <= k + 1))
        decision = _decision(constant(method), state, alike, held, size(change), sizes, higher)
        # What is algebraic may jump, and the history with it.
        smooth = method.tail * size(change * args.structure.differential) < 1
        jumped = constant(is_smallest(t0, t1) & newton.converged & (passes | (decision.factor < SAFETY)) & smooth)
        error = (jnp.where(jumped, 2, decision.factor) / SAFETY) ** -ERROR_ORDER
        failure = of_step(newton.converged, factors.probe.determined, error)
        error = jnp.where(newton.converged, error, jnp.inf) * tol.scale(y0, y1)
        y1, error, result = at_min_step(failure, t0, t1, y0, y1, constant(error))
        phi = jnp.stack(phi)
        new = _State(
            phi[1:], method.psi, state.steps + 1, decision.order, k, alike, decision.rising, decision.factor * h,
            held | (state.held & (decision.order > k)),
            *constant((factors, method.c, newton.eta, work)),
        )  # fmt: skip
        new = jax.tree.map(lambda a, b: jnp.where(jumped, a, b), _start(jnp.zeros_like(y1), new.factors, new.work), new)
        # Numbers, all of them: diffrax fills what is not reached with infinity.
        marks = (x.astype(y0.dtype) for x in (k, jumped, state.steps == 0))
        dense = {"phi": phi, "psi": method.psi, **dict(zip(("order", "jumped", "first"), marks, strict=True))}
        return y1, error, dense, new, result

    def history_at_start(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        start = _start(time_sign(terms, t0, t1) * args.start, None, Work.none())
        return start.phi, start.psi

    def history_after(self, dense: Any) -> Any:
        return jnp.where(dense["jumped"] > 0, 0, dense["phi"][1:]), dense["psi"]

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> Any:
        h, sign, k = jnp.where(t1 == t0, 1, t1 - t0), time_sign(terms, t0, t1), dense["order"].astype(int)
        phi, psi = history
        method = _formula(k, dense["first"] > 0, psi, h)
        step, star = _predicted(method, k, phi, args.solved_by(self.linear_solver), sign, t1, h, y0)
        found = constant(dense["phi"][0]), tolerances(self.rtol, self.atol, y0.dtype)
        y1, _ = _point(lambda params: (params[1], ()), (step, *found))
        dense = {**dense, "phi": jnp.stack(_differences(y1 - step.y, star, k)[1]), "psi": method.psi}
        return y1, self.history_after(dense), dense


def _predicted(
    method: "_Formula", k: Any, phi: Any, args: Any, sign: Any, t1: Time, h: Any, y0: Any
) -> tuple[_Step, list[Any]]:
    """The equation of a step of order k, and the differences that predict it."""
    star = [y0] + [b * row for b, row in zip(method.beta[1:], phi, strict=True)]
    zero = jnp.zeros_like(y0)
    y = sum((jnp.where(j <= k, row, 0) for j, row in enumerate(star)), zero)
    rate = sum((jnp.where(j <= k, g * row, 0) for j, (g, row) in enumerate(zip(method.gamma, star, strict=True))), zero)
    return _Step(args, sign, t1, h, method.c, y, rate), star


def _point(iterate: Callable[[Any], Any], params: Any) -> tuple[Float[Array, " n"], Any]:
    """y at t₁, and how it was found, with its derivative; `params` holds the `_Step` first and the tolerances last."""
    return implicit_root(
        lambda y, params: params[0].residual(y),
        iterate,
        params,
        linear_solve=lambda inverse, b: inverse(b),
        jacobian=lambda y, params: functools.partial(
            params[0].linearised.solve, params[0].factor(y, params[-1]).matrix
        ),
    )


def _differences(change: Any, star: list[Any], k: Any) -> tuple[Any, list[Any]]:
    """The change and the new differences: row j is the change and all rows from j to k; rows above k are not used yet, or
    are φₖ₊₁.
    """
    phi = [change]
    for j in reversed(ROWS):
        phi.append(jnp.where(j <= k, phi[-1] + star[j], phi[-1]))
    return change, phi[:0:-1]


def _start(ydot: Float[Array, " n"], factors: Any, work: Work) -> _State:
    """No history: φ₁ is dy/dτ, to be multiplied by the size of the first step. It predicts only."""
    zero, count = jnp.zeros((), ydot.dtype), jnp.zeros((), int)
    phi = jnp.stack([ydot] + [jnp.zeros_like(ydot)] * (MAX_ORDER - 1))
    return _State(
        phi,
        jnp.ones(len(ROWS), ydot.dtype),
        count,
        count + 1,
        count,
        count,
        count == 0,
        zero,
        count > 0,
        factors,
        zero,
        zero + 1,
        work,
    )


class _Formula(NamedTuple):
    """The coefficients of a step of order k: φ* = β φ, ẏ* = Σ γ φ*, c; the error is σ_k or, that of the interpolation
    included, `tail` times y − y*. `psi` belongs to the new point; `constant`: the size is that of the last step.
    """

    beta: list[Any]
    gamma: list[Any]
    sigma: list[Any]
    tail: Any
    c: Any
    psi: Any
    constant: Any


def _formula(k: Any, first: Any, psi: Any, h: Any) -> _Formula:
    old = [jnp.where(first, (j + 1) * h, psi[j]) for j in ROWS]
    new = [h] + [x + h for x in old[:-1]]
    alpha = [h / x for x in new]
    beta, gamma, sigma = [jnp.ones_like(h)], [jnp.zeros_like(h)], [jnp.ones_like(h)]
    for j in ROWS[1:]:
        beta.append(beta[-1] * (new[j - 1] / old[j - 1]))
        gamma.append(gamma[-1] + 1 / new[j - 1])
        sigma.append(sigma[-1] * j * alpha[j])
    # φ₁ of a start is a derivative.
    beta = [beta[0]] + [jnp.where(first, h, b) for b in beta[1:]]
    leading = sum(jnp.where(j <= k, 1 / j, 0) for j in ROWS[1:])
    variable = sum(jnp.where(j < k, alpha[j], 0) for j in ROWS)
    tail = jnp.maximum(jnp.abs(_at(alpha, k) - leading + variable), _at(alpha, k))
    constant_size = jnp.abs(h - old[0]) <= ALIKE * h
    return _Formula(beta, gamma, sigma, tail, leading / h, jnp.stack(new), constant_size)


def _at(rows: list[Any], k: Any) -> Any:
    """Row k; 0 outside."""
    return sum(jnp.where(j == k, row, 0) for j, row in enumerate(rows))


def _solve(step: _Step, y0: Any, state: _State, smallest: Any, tol: Tolerances) -> Any:
    """y at t₁, and how it was found: with the factors at hand first, with new ones where these fail, and in the smallest
    step with new ones for each correction.
    """
    weights, differential = step.linearised.weights(step.h), step.linearised.structure.differential
    changed = jnp.abs(step.c - state.c) > ALIKE * step.c

    def attempt(carry: Any) -> Any:
        tries, fresh, before, _, factors, work = carry
        renew = (tries > 0) | changed
        start = start_of(tries, step.y, before)
        new = lambda: step.factor(start, tol)
        factors = lax.cond(renew, new, lambda: factors)
        correction = lambda residual: -step.linearised.solve(factors.matrix, residual)
        combined = lambda rows: step.linearised.combined(rows, step.c)
        iteration = Iteration(step.residual, correction, combined, factors.round_off, factors.enough)
        scale = lambda y: weights / tol.scale(y0, y)
        eta = jnp.where(renew, 1, state.eta)
        # Here, since each function would have it.
        off = iteration.residual(start)
        newton = lax.cond(
            smallest & (tries > 0),
            lambda: corrected(iteration, start, off, tries, scale, differential, eta, tol),
            lambda: simplified_newton(iteration, start, off, weights / tol.scale(y0), eta, tol),
        )
        solve = functools.partial(step.linearised.solve, factors.matrix)
        seen = before.converged | factors.probe.determines(solve, step.residual, newton.x)
        return tries + 1, fresh | renew, newton, seen, factors, work.and_of(renew, renew, newton.count)

    def again(carry: Any) -> Any:
        tries, fresh, newton, seen, *_ = carry
        return goes_on(tries, newton.converged, seen, fresh, smallest)

    no = jnp.asarray(False)
    first = (0, no, not_begun(step.y, state.eta), no, state.factors, state.work)
    _, fresh, newton, _, factors, work = lax.while_loop(again, attempt, first)
    # The rate with new factors says nothing of the next step, for which they are old.
    eta = jnp.where(fresh, 1, newton.eta)
    passes = passes_a_kink(newton, smallest, state.steps > 0)
    y = jnp.where(newton.converged | passes & differential, newton.x, jnp.where(passes, y0, step.y))
    found = newton._replace(x=None, eta=eta, converged=newton.converged | passes)
    return y, (found, passes, factors, work)


class _Decision(NamedTuple):
    """The next size in parts of this one, less than SAFETY for a step that fails, and the next order."""

    factor: Any
    order: Any
    rising: Any


def _decision(
    method: _Formula, state: _State, alike: Any, held: Any, change: Any, sizes: list[Any], higher: Any
) -> _Decision:
    """The next order is that with the least term hʲ y⁽ʲ⁾ of the series.

    At the start, order and size rise with each step; later the order rises after k + 1 steps of one size and order, and
    the size where it can be doubled, unless it is `held`: where it was doubled and the step failed, the order comes first.
    """
    k = state.order
    errors = _at(method.sigma, k - 1) * _at(sizes, k), _at(method.sigma, k) * change, higher / (k + 2)
    low, here, high = (error * (k + j) for j, error in enumerate(errors))
    lowest = (k - 1) * _at(method.sigma, k - 2) * _at(sizes, k - 1)
    falls = jnp.where(k > 2, jnp.maximum(low, lowest) <= here, (k == 2) & (low <= here / 2))
    # The points of a lower order bend where the order rose, and at the start the differences are round-off.
    falls = falls & (k <= state.used) & (~state.rising | (here > SIGNIFICANT))
    falls = falls & (~held | (method.tail * change >= 1))
    rising = state.rising & ~falls & (k < MAX_ORDER)
    settled = ~rising & (alike > k + 1) & (k - state.used != 1) & (k < MAX_ORDER)
    falls = falls | (settled & (k > 1) & (low <= jnp.minimum(here, high)))
    rises = (settled & ~falls & (high < jnp.where(k == 1, here / 2, here))) | (rising & (state.steps > 0))
    order = k + rises - falls
    accepted = method.tail * change < 1
    expected = jnp.where(accepted, _at(list(errors), order - k + 1), errors[1])
    exponent = (jnp.where(accepted, order, k) + 1).astype(expected.dtype)
    ratio = (2 * expected + 1e-4) ** (-1 / exponent)
    # An accepted step is followed by one of its size exactly, or by one of twice its size.
    double = (ratio >= 2) & ~rising & ~held | rising & rises
    factor = jnp.where(accepted, jnp.where(double, 2, 0.95), jnp.clip(0.9 * ratio, 0.25, 0.89))
    return _Decision(factor, order, rising)
