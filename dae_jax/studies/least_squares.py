"""The Levenberg–Marquardt method in units of its own, and the end of it that statistics ask for.

With r(x) and J = ∂r/∂x, D_j the largest length so far of the j-th column of J, and J D⁻¹ = U S Vᵀ, a step is

    (JᵀJ + λ D²) d = −Jᵀr,    d = −D⁻¹ V (S/(S² + λ)) Uᵀr,

so that units of the parameters do not count. It is at its end where what is left of r in the tangent plane, U of J itself, is
small beside what no parameter explains: the distance to the minimum in standard errors is

    |Uᵀr|/√p ÷ |r − U Uᵀr|/√(m − p),        or |Uᵀr|/√p where r is in units of noise that is known.

Sources: J. J. Moré, *The Levenberg–Marquardt algorithm*, Lecture Notes in Mathematics 630 (1978), 105–116; D. M. Bates, D. G. Watts,
*A relative offset orthogonality convergence criterion for nonlinear least squares*, Technometrics 23 (1981), 179–183.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from ..types import BoolScalar, IntScalar, Scalar


# Of what is no more than so many times its round-off, nothing is known.
ROUND_OFF = 16
# By what part of what is measured the model is moved to see which way |r|² is bent.
SHOWN = 1e-3
# The most Gauss–Newton steps from where the descent ends.
POLISHED = 6

Point: TypeAlias = Float[Array, " p"]
Residual: TypeAlias = Float[Array, " m"]
Jacobian: TypeAlias = Float[Array, "m p"]


class Minimum(NamedTuple):
    """Where the descent ended: r and J there, its steps, and the distance to the minimum in standard errors; whether |r|² is `bent` up
    there in all directions that are seen.
    """

    x: Point
    residual: Residual
    jacobian: Jacobian
    steps: IntScalar
    offset: Scalar
    converged: BoolScalar
    bent: BoolScalar


class Factors(NamedTuple):
    """J D⁻¹ = U S Vᵀ, where D are the lengths of J's columns unless others are given."""

    u: Float[Array, "m k"]
    s: Float[Array, " k"]
    vt: Float[Array, "k p"]
    scale: Float[Array, " p"]

    @property
    def seen(self) -> Float[Array, " k"]:
        """1 of a singular value that is more than 0: to half the digits, as a solve's tolerance and round-off are in J."""
        half = jnp.sqrt(jnp.finfo(self.s.dtype).eps)
        return (self.s > half * jnp.max(self.s, initial=0)).astype(self.s.dtype)


def factors(jacobian: Jacobian, scale: Float[Array, " p"] | None = None) -> Factors:
    """Those of J; a column that is 0 is not scaled."""
    scale = lengths(jacobian) if scale is None else scale
    scale = jnp.where(scale > 0, scale, 1)
    u, s, vt = jnp.linalg.svd(jacobian / scale, full_matrices=False)
    return Factors(u, s, vt, scale)


def lengths(jacobian: Jacobian) -> Float[Array, " p"]:
    """Those of its columns. In float32 the square of 1e20, as of a derivative by a molecule's mass, would be infinite."""
    largest = jnp.max(jnp.abs(jacobian), 0, initial=0)
    unit = jnp.where(largest > 0, largest, 1)
    return unit * jnp.linalg.norm(jacobian / unit, axis=0)


class _Linearised(eqx.Module):
    """r and J at the last point that was accepted, the factors for a step, and the largest |r| so far."""

    residual: Residual
    jacobian: Jacobian
    scaled: Factors
    largest: Scalar


class _Marquardt(optimistix.AbstractDescent[Point, Any, _Linearised]):
    """d for λ = 1/step size."""

    def init(self, y: Point, f_info_struct: Any) -> _Linearised:
        m, p = f_info_struct.residual.size, y.size
        k, zeros = min(m, p), lambda *shape: jnp.zeros(shape, y.dtype)
        return _Linearised(zeros(m), zeros(m, p), Factors(zeros(m, k), zeros(k), zeros(k, p), zeros(p)), zeros())

    def query(self, y: Point, f_info: Any, state: _Linearised) -> _Linearised:
        r, jacobian = f_info.residual, f_info.jac.as_matrix()
        scaled = factors(jacobian, jnp.maximum(state.scaled.scale, lengths(jacobian)))
        return _Linearised(r, jacobian, scaled, jnp.maximum(state.largest, jnp.linalg.norm(r)))

    def step(self, step_size: Scalar, state: _Linearised) -> tuple[Point, optimistix.RESULTS]:
        u, s, vt, scale = state.scaled
        damped = s / (s**2 + 1 / step_size) * (u.T @ state.residual)
        return -(vt.T @ damped) / scale, optimistix.RESULTS.successful


class _LevenbergMarquardt(optimistix.AbstractGaussNewton[Point, Residual, Any]):
    descent: _Marquardt
    search: optimistix.ClassicalTrustRegion[Point]
    tolerance: float = eqx.field(static=True)
    known: bool = eqx.field(static=True)
    magnitude: Scalar
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[..., Scalar] = optimistix.max_norm
    verbose: Callable[..., None] = lambda **_: None

    def terminate(
        self, fn: Any, y: Point, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[BoolScalar, optimistix.RESULTS]:
        _, done = self.offset(state.descent_state)
        return done & ~state.first_step, state.result

    def offset(self, at: _Linearised) -> tuple[Scalar, BoolScalar]:
        """The distance to the minimum in standard errors, and whether that is small, or round-off."""
        u, seen, r = (found := factors(at.jacobian)).u, found.seen, at.residual
        inside, count = jnp.linalg.norm(seen * (u.T @ r)), jnp.sum(seen)
        outside = jnp.linalg.norm(r - u @ (seen * (u.T @ r))) / jnp.sqrt(jnp.maximum(r.size - count, 1))
        distance, noise = inside / jnp.sqrt(jnp.maximum(count, 1)), 1.0 if self.known else outside
        size = jnp.maximum(self.magnitude, at.largest)
        # Data without noise are met up to round-off, which is in the tangent plane as much as anywhere.
        met = (inside == 0) | (jnp.linalg.norm(r) <= ROUND_OFF * jnp.finfo(r.dtype).eps * size) & (not self.known)
        offset = jnp.where(met, 0 * inside, distance / noise)
        return offset, (offset <= self.tolerance) | (inside <= jnp.finfo(r.dtype).eps ** (2 / 3) * size)


def minimum(
    value_and_jacobian: Callable[[Point], tuple[Residual, Jacobian]],
    start: Point,
    *,
    known: bool,
    magnitude: Scalar,
    tolerance: float,
    steps: int,
) -> Minimum:
    """The minimum of |r|². `known`: whether r is in units of its noise; `magnitude`: of what r is the difference of."""
    # It is traced once for the descent and for what follows it.
    value_and_jacobian = jax.jit(value_and_jacobian)

    def linearised(x: Point, _: None) -> Residual:
        # J comes with r in one pass of forward directions, and is handed to whoever differentiates.
        fixed = jax.lax.stop_gradient(x)
        r, jacobian = value_and_jacobian(fixed)
        return r + jacobian @ (x - fixed)

    # Where residuals stay, no step is as good as the linear model says: three quarters of it must do for λ to fall.
    search = optimistix.ClassicalTrustRegion(high_cutoff=0.75)
    method = _LevenbergMarquardt(
        descent=_Marquardt(), search=search, tolerance=tolerance, known=known, magnitude=magnitude
    )
    found = optimistix.least_squares(linearised, method, start, max_steps=steps, throw=False)
    at: Any = found.state.descent_state
    offset, converged = method.offset(at)
    steps = found.stats["num_steps"]

    def unfinished(carry: Any) -> BoolScalar:
        *_, offset, more, count = carry
        return more & (offset > tolerance) & (count < POLISHED)

    def polish(carry: Any) -> Any:
        x, at, offset, _, count = carry
        u, s, vt, scale = found = factors(at.jacobian)
        step = -(vt.T @ (found.seen * (u.T @ at.residual) / jnp.where(found.seen > 0, s, 1))) / scale
        r, jacobian = value_and_jacobian(x + step)
        new = eqx.tree_at(lambda a: (a.residual, a.jacobian), at, (r, jacobian))
        smaller, _ = method.offset(new)
        better = (smaller < offset / 2) & (jnp.linalg.norm(r) <= (1 + tolerance) * jnp.linalg.norm(at.residual))
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (x + step, new, smaller), (x, at, offset))
        return *kept, better, count + 1

    # What seemed round-off may be noise: whole steps tell, which lead to the minimum where the digits suffice.
    first = (found.value, at, offset, converged, jnp.zeros_like(steps))
    x, at, offset, _, more = jax.lax.while_loop(unfinished, polish, first)
    bent = _is_bent_up(value_and_jacobian, x, at, magnitude)
    return Minimum(x, at.residual, at.jacobian, steps + more, offset, converged, bent)


def _is_bent_up(
    value_and_jacobian: Callable[[Point], tuple[Residual, Jacobian]], x: Point, at: _Linearised, magnitude: Scalar
) -> BoolScalar:
    """Whether Jᵀr grows along each direction v that is seen, from where it is 0: at a maximum of |r|², or a saddle, it does not. It is
    compared with that at x + v, which the model shows as a thousandth of what is measured.
    """
    _, s, vt, scale = found = factors(at.jacobian)
    show = SHOWN * jnp.maximum(magnitude, at.largest)

    def grows(k: IntScalar, bent: BoolScalar) -> BoolScalar:
        seen = found.seen[k] > 0
        v = vt[k] / scale * jnp.where(seen, show / jnp.where(seen, s[k], 1), 0)
        r, jacobian = value_and_jacobian(x + v)
        growth = (jacobian @ v) @ r - (at.jacobian @ v) @ at.residual
        return bent & ~(seen & (growth < 0))

    return jax.lax.fori_loop(0, found.s.size, grows, jnp.asarray(True))
