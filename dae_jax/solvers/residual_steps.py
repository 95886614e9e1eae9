"""What the solvers of residuals have in common: tolerances, Newton's method, and what becomes of a step that failed."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..linalg import rms_norm
from ..linalg.iterative import GMRES
from ..types import BoolLike


# As equinox has it.
if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar


# The part of the tolerance that round-off may use up (BCP, section 5.2.2).
NOISE = 0.33
# What the first and a later correction may leave of an equation, in parts of what they change there; and what of it may be
# round-off, in parts of its terms and of the resolution of numbers.
FIRST_LEFT, LEFT, OFF = 0.5, 2, 1000
# What the last correction may leave, in parts of the tolerance, as the equations are seen to have it.
UNSOLVED = 0.03
# Round-off of the divided differences of algebraic variables, in parts of the variables over h.
NOISY = 1000
# Step sizes that differ by less, relatively, are the same: their iteration matrices are.
ALIKE = 1e-6
# The part of the step-size controller in h_new = h · SAFETY · error^(−1 / order).
SAFETY = 0.9
# Corrections of a step that is not tried again with a smaller size, at most.
PATIENT = 50
# How often a correction is halved where algebraic variables jump.
HALVINGS = 40
# Where algebraic variables jump, Newton's method has a Jacobian of its own for each of its corrections: damped ones first, for
# a whole one may end where a function overflows; then whole ones, for a damped iteration may end before a kink.
DAMPED, WHOLE = 40, 6


class Work(NamedTuple):
    """What the accepted steps have taken: Jacobians, factorisations, corrections of Newton's method."""

    num_jacobians: Int[Array, ""]
    num_factorisations: Int[Array, ""]
    num_corrections: Int[Array, ""]

    @classmethod
    def none(cls) -> "Work":
        """Before the first step."""
        return cls(*[jnp.zeros((), int)] * 3)

    def and_of(self, jacobian: Any, factorisation: Any, corrections: Any) -> "Work":
        """With that of a try of a step."""
        return Work(*(x + y for x, y in zip(self, (jacobian, factorisation, corrections), strict=True)))


class AbstractResidualSolver(diffrax.AbstractAdaptiveSolver):
    """A solver of 0 = F(t, y, ẏ); needs a `LinearisedResidual` as `args`, one that is `starting`.

    `rtol`, `atol`: the tolerances that Newton's method is fitted to; by default those of the step-size controller, and
    round-off for fixed steps. `linear_solver`: by which linear equations are solved, if not by factors.
    """

    # Up to which index the method converges, and takes the equations as they are written where nothing else is asked for.
    highest_index: AbstractClassVar[int]
    default_index: AbstractClassVar[int]
    # Which entries of its state at the end of a solve are counts for `stats`, by their paths.
    counts: ClassVar[tuple[str, ...]] = tuple(f"work.{name}" for name in Work._fields)

    rtol: Any = None
    atol: Any = None
    linear_solver: GMRES | None = eqx.field(default=None, kw_only=True, static=True)

    term_structure = diffrax.AbstractTerm

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    @abc.abstractmethod
    def invalidate_jacobian(self, state: Any) -> Any:
        """The solver's state without its iteration matrix, for equations that are others now for the same unknowns."""

    def formula(self, state: Any) -> Int[Array, ""] | None:
        """The number, up to 127, of the formula that the next step is made by; None where all are made by one."""
        return None

    def by_formula(self, state: Any, formula: Int[Array, ""]) -> Any:
        """The state from which the next step is made by the formula of this number."""
        return state


class Tolerances(NamedTuple):
    """`rtol`, `atol`; what Newton's method may leave, as a part of these: `newton`, and `roundoff` where it gets no
    further, in at most `corrections`;
    `patient` where a step that fails is not tried again with a smaller size.
    """

    rtol: Any
    atol: Any
    newton: Any
    roundoff: Any
    corrections: Any
    patient: BoolLike

    def waiting(self, patient: BoolLike) -> "Tolerances":
        """With as many corrections as a step may need that is not tried again with a smaller size, where `patient`."""
        corrections = jnp.where(patient, jnp.maximum(self.corrections, PATIENT), self.corrections)
        return self._replace(corrections=corrections, patient=jnp.asarray(self.patient) | patient)

    def raised(self) -> Any:
        """How much more than h^(k−1) the error of a variable of index k > 1 counts on the way between the ends of a step: its
        round-off grows like 1/h^(k−1).
        """
        smallest = jnp.max(self.rtol)
        return smallest / (NOISY * jnp.finfo(smallest.dtype).eps)

    def scale(self, *ys: Float[Array, " n"]) -> Float[Array, " n"]:
        """The error that is allowed in each variable."""
        largest = jnp.abs(ys[0])
        for y in ys[1:]:
            largest = jnp.maximum(largest, jnp.abs(y))
        return self.atol + self.rtol * largest

    def round_off(self, linearised: Any, j: Any, m: Any, c: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """What each equation may be off by for certain, where the iteration matrix is J + c M."""
        return OFF * jnp.finfo(y.dtype).eps * linearised.terms(j, m, c, jnp.abs(y) + self.atol)

    def enough(self, linearised: Any, j: Any, m: Any, c: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """What each equation may be off by at most: what the errors that are allowed in its variables amount to."""
        return NOISE * linearised.terms(j, m, c, self.scale(y))

    def norm(self, error: Any, *ys: Any) -> Float[Array, ""]:
        """The size of an error; 1 is allowed."""
        return rms_norm(error / self.scale(*ys))


def tolerances(rtol: Any, atol: Any, dtype: Any) -> Tolerances:
    """Fitted to those of the step-size control, or to round-off for fixed steps, where they are `None`.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, the program RADAU5, for `newton`.
    """
    epsilon = float(jnp.finfo(dtype).eps)
    patient = rtol is None
    rtol, atol = (epsilon ** (2 / 3) if x is None else x for x in (rtol, atol))
    largest = jnp.maximum(jnp.max(jnp.asarray(rtol, dtype)), epsilon)
    newton = jnp.maximum(epsilon / largest, jnp.minimum(0.03, jnp.sqrt(largest)))
    roundoff = jnp.maximum(100 * epsilon / largest, newton / 10)
    return Tolerances(
        *lax.stop_gradient((jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype), newton, roundoff)),
        PATIENT if patient else 10,
        patient,
    )


class Newton(NamedTuple):
    """An iteration that ended, or has yet to begin: the solution `x`, the number of corrections, the size of the last
    one, η = θ/(1 − θ) and θ, the rate at which they shrink; `carried`: whether the last left the differential variables as
    they were.
    """

    x: Any
    count: Any
    last: Any
    eta: Any
    theta: Any
    converged: Any
    diverged: Any
    carried: Any


def not_begun(start: Any, eta: Any) -> Newton:
    """The iteration before its first correction."""
    zero, no = jnp.zeros((), start.dtype), jnp.asarray(False)
    return Newton(start, 0, zero, eta, zero, no, no, no)


class Iteration(NamedTuple):
    """F(x), the solution of A Δx = −F for the iteration matrix A at hand, and F `combined` so that each equation says something
    of its own where highest derivatives cancel between them; what of these may be `round_off`, and what is `enough`.
    """

    residual: Callable[[Any], Any]
    correction: Callable[[Any], Any]
    combined: Callable[[Any], Any]
    round_off: Any
    enough: Any

    def after(self, x: Any, dx: Any, before: Any, allowed: Any = LEFT) -> tuple[Any, Any]:
        """F at x, and whether the size of the correction Δx that led there says how far the solution is: by a matrix from
        where F was steep it is small wherever that is. Each equation has to be one that about as much more of Δx puts right,
        by its slope at x or by what Δx has changed of F `before` (at most `allowed` of it), or right to round-off; and by no more
        than is `enough`: that a velocity's error counts h of it says nothing of the part that no constraint determines.
        """
        left, change = jax.jvp(self.residual, (x,), (dx,))
        rows, changes, changed = map(self.combined, (left, change, left - before))
        moved = jnp.minimum(allowed * jnp.maximum(jnp.abs(changes), jnp.abs(changed)), self.enough)
        return left, jnp.all(jnp.abs(rows) <= jnp.maximum(moved, self.round_off))


def simplified_newton(
    iteration: Iteration, start: Any, off: Any, scale: Any, eta: Any, tol: Tolerances, pace: Any = None
) -> Newton:
    """Corrects `start`, where F is `off`, until what remains, η ‖Δx‖, is small beside the tolerance; ‖Δx‖ is that of Δx · `scale`.

    `pace`: the scale in which the method contracts, where that is another: a variable of index k counts h^(k−1) in it. What a
    correction leaves of the others is divided by h^(k−1) in these, so that the first one tells nothing of them.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, section IV.8.
    """
    epsilon = jnp.finfo(start.dtype).eps

    def goes_on(carry: Any) -> Any:
        s, _ = carry
        return ~s.converged & ~s.diverged & (s.count < tol.corrections)

    def correct(carry: Any) -> Any:
        s, off = carry
        dx = iteration.correction(off)
        x = s.x + dx
        size = rms_norm(dx * scale)
        allowed = jnp.minimum(jnp.where(s.count == 0, FIRST_LEFT, LEFT), UNSOLVED / size)
        left, trusted = iteration.after(x, dx, off, allowed)
        step = size if pace is None else rms_norm(dx * pace)
        theta = step / jnp.maximum(s.last, jnp.finfo(start.dtype).tiny)
        first = s.count == 0
        eta = jnp.where(first, jnp.maximum(s.eta, 1e-3) ** 0.8, theta / jnp.maximum(1 - theta, epsilon))
        remaining = tol.corrections - 1 - s.count
        stagnant = ~first & (theta >= 1)
        hopeless = stagnant | (eta * step * theta**remaining > tol.newton) & (step > NOISE)
        known = ~stagnant if pace is None else ~stagnant & ~first
        # Only one that does not shrink any more is round-off: what is left of a position comes back divided by h in its velocity.
        noise = stagnant & (size <= jnp.maximum(tol.roundoff, NOISE))
        small = (eta * size <= tol.newton) & known | (size <= tol.newton / 10) | noise
        converged = small & trusted
        diverged = ~jnp.isfinite(size) | (~first & hopeless & ~converged & ~jnp.asarray(tol.patient))
        theta = jnp.where(first, 0, theta)
        return Newton(x, s.count + 1, step, eta, theta, converged & jnp.isfinite(size), diverged, s.carried), left

    return lax.while_loop(goes_on, correct, (not_begun(start, eta), off))[0]


def goes_on(tries: Any, converged: Any, seen: Any, fresh: Any, smallest: Any) -> Any:
    """Whether a step is tried again: with new factors, and many times where it can be no smaller; once it has converged with a
    matrix that is not that of its end, with that one, which has to be `seen`: it may be singular.
    """
    return (tries == 0) | converged & ~seen | ~converged & (~fresh | smallest & (tries <= DAMPED + WHOLE))


def start_of(tries: Any, predicted: Any, before: Newton) -> Any:
    """Where the next of the tries of a step starts: where the last ended, if that converged, or for corrections of one iteration."""
    return jnp.where(~before.converged & ((tries <= 1) | (tries == DAMPED + 1)), predicted, before.x)


def corrected(
    iteration: Iteration,
    x: Any,
    off: Any,
    tries: Any,
    scale: Callable[[Any], Any],
    differential: Any,
    eta: Any,
    tol: Tolerances,
) -> Newton:
    """One correction x + λ Δx from where F is `off`, in the first tries with λ the largest power of ½ with which the next correction by
    the same matrix is smaller, ‖Δx̄‖ ≤ (1 − λ/2) ‖Δx‖; then a whole one. Converged where it is whole and the next one is small;
    `scale(x)` is what a correction counts near x.

    Source: P. Deuflhard, *Newton Methods for Nonlinear Problems*, sec. 3.1.4 (the restricted monotonicity test).
    """
    dx = iteration.correction(off)
    scale_there = scale(x + dx)
    size = rms_norm(dx * scale_there)

    def halve(carry: Any) -> Any:
        part, *_, count = carry
        left, trusted = iteration.after(x + part * dx, dx, off)
        ahead = rms_norm(iteration.correction(left) * scale_there)
        taken = (tries > DAMPED) | (ahead <= (1 - part / 2) * size)
        return jnp.where(taken, part, part / 2), ahead, taken, trusted, count + 1

    no = jnp.asarray(False)
    begin = jnp.ones((), x.dtype), jnp.asarray(jnp.inf, x.dtype), no, no, 0
    part, ahead, taken, trusted, _ = lax.while_loop(lambda carry: ~carry[2] & (carry[4] < HALVINGS), halve, begin)
    # Corrections that are round-off grow and shrink as they please.
    noise = (size <= tol.roundoff) | ~(ahead < size) & (size <= NOISE)
    converged = trusted & ((ahead <= tol.newton) & taken & (part == 1) | noise)
    x = jnp.where(taken | converged, x + part * dx, x)
    finite = jnp.isfinite(size)
    carried = finite & (rms_norm(dx * scale_there * differential) <= NOISE)
    return Newton(x, 1, size, eta, jnp.zeros_like(size), converged & finite, ~finite, carried)


def passes_a_kink(newton: Newton, smallest: Any, after_others: Any) -> Any:
    """Whether a smallest step, `after_others`, counts although its algebraic variables were not found: on a kink that the
    differential ones pass unmoved, Newton's method may go to and fro between the sides. The step after it has to find them.
    """
    return smallest & after_others & ~newton.converged & newton.carried


class Failure(NamedTuple):
    """Whether a step came to nothing: `found` is false where Newton's method did not converge, `singular` says that the
    iteration matrix is why; `accurate` is false where the error is too large.
    """

    found: Any
    singular: Any
    accurate: Any


def of_step(found: Any, determined: Any, error: Any) -> Failure:
    """What went wrong, by whether the iteration matrix determines all unknowns, without which none counts, and the scaled error."""
    return Failure(found & determined, ~determined, error < 1)


def is_smallest(t0: Any, t1: Any) -> Bool[Array, ""]:
    """Whether time resolves no smaller step."""
    resolution = 16 * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    return t1 - t0 <= jnp.maximum(resolution, jnp.finfo(t0.dtype).tiny ** 0.75)


def at_min_step(failure: Failure, t0: Any, t1: Any, y0: Any, y1: Any, error: Any) -> tuple[Any, Any, diffrax.RESULTS]:
    """(y₁, error, result) of a step. One that came to nothing has an infinite error, so that a smaller one is tried; where
    time resolves no smaller one, the error is 0, y₁ = y₀, and the result tells an adaptive solve why it ends here.
    """
    # pyright knows no code that is inherited.
    codes: Any = diffrax.RESULTS
    smallest = is_smallest(t0, t1)
    result = codes.where(failure.singular, codes.singular, codes.nonlinear_divergence)
    result = codes.where(failure.found, codes.successful, result)
    result = codes.where(failure.found & ~failure.accurate & smallest, codes.dt_min_reached, result)
    ended = smallest & ~(failure.found & failure.accurate)
    y1 = jnp.where(ended, y0, jnp.where(failure.found, y1, jnp.nan))
    error = jnp.where(ended, 0, jnp.where(failure.found, error, jnp.inf))
    return y1, error, result


def within(t: Any, t0: Any, t1: Any) -> Any:
    """t, moved into the interval. Unlike that of `clip`, which is a half there, the derivative at the ends is that of t."""
    return jnp.where(t < t0, t0, jnp.where(t > t1, t1, t))


def first_step(ydot: Float[Array, " n"], solver: Any, t0: Any, t1: Any, y0: Float[Array, " n"]) -> Any:
    """The size of the first step, from ẏ at the start: no variable moves by more than half its tolerance in it, if time resolves that.

    Source: K. E. Brenan, S. L. Campbell, L. R. Petzold, *Numerical Solution of Initial-Value Problems in
    Differential-Algebraic Equations*, section 5.2.4.
    """
    span = t1 - t0
    tol = tolerances(solver.rtol, solver.atol, y0.dtype)
    speed = tol.norm(ydot, y0)
    resolved = 100 * jnp.finfo(y0.dtype).eps * jnp.abs(t0)
    step = jnp.minimum(1e-3 * jnp.abs(span), jnp.maximum(0.5 / jnp.maximum(speed, 1e-30), resolved))
    return lax.stop_gradient(jnp.sign(span) * step)
