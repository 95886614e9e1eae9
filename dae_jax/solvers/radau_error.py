"""The error of a step of Radau IIA: that of the embedded formula, and that of the polynomial between the ends."""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .radau_coefficients import Coefficients
from .radau_step import Step, along
from .residual_steps import Tolerances


def error_of_step(
    step: Step, factor: Any, z: Float[Array, "s n"], past: Any, *, tol: Tolerances, dense: bool
) -> Float[Array, " n"]:
    """The error that counts of each variable. `past` has the stages and the size of the step before, `dense` is whether
    values between the ends are wanted.

    Of what the filter has made small in several evaluations that of the polynomial counts, up to the estimate that was
    filtered once: with x' = z, R z = u(t) − x and R ≪ h the filter takes all of the error of z.
    """
    linearised, ends = step.linearised, (step.y0, step.y0 + z[-1])
    once, filtered = embedded(step, factor, z, tol)
    shown, always = linearised.form.shown, linearised.between(dense)
    if not shown.any():
        return filtered
    polynomial = _between(step.method, past, step.h, z) * linearised.weights(step.h, tol.raised())
    counted = polynomial * always
    if (shown & ~always).any():
        doubted = shown & (jnp.abs(once) >= tol.scale(*ends)) & (tol.norm(filtered, *ends) < 1)
        least = jnp.where(jnp.abs(once) < jnp.abs(polynomial), once, polynomial)
        counted = jnp.where(doubted & ~always, least, counted)
    return jnp.where(jnp.abs(counted) > jnp.abs(filtered), counted, filtered)


def embedded(step: Step, factor: Any, z: Any, tol: Tolerances) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """−(γ/h M + J)⁻¹ F(t₀, y₀, −Σ eᵢ zᵢ/h), and where that is large once more from y₀ + error (eqs. IV.8.19, IV.8.20)."""
    rate = sum(float(e) * z[i] for i, e in enumerate(step.method.error)) * (-step.sign / step.h)
    weights = step.linearised.weights(step.h)

    def again(carry: Any) -> Any:
        count, _, _, size = carry
        return (count == 0) | (count == 1) & ~(size < 1)

    def estimate(carry: Any) -> Any:
        count, once, error, _ = carry
        error = -step.linearised.solve(factor, step.linearised.residual(step.sign * step.t0, step.y0 + error, rate))
        size = tol.norm(error * weights, step.y0, step.y0 + z[-1])
        return count + 1, jnp.where(count == 0, error, once), error, size

    zero = jnp.zeros_like(step.y0)
    _, once, error, _ = lax.while_loop(again, estimate, (0, zero, zero, jnp.zeros_like(step.h)))
    return once * weights, error * weights


def _between(method: Coefficients, past: Any, h: Any, z: Float[Array, "s n"]) -> Float[Array, " n"]:
    """The largest error of the polynomial through the step's points, by the start of the step before."""
    none = past.h == 0
    # 1 where there was none, which is as good as any.
    before = reach = -jnp.where(none, 1, past.h / h)
    for c in method.nodes:
        reach = reach * (before - float(c))
    off = along(z, before) + past.z[-1]
    at_start = sum(float(c) * z[i] for i, c in enumerate(method.at_start))
    return jnp.where(none, at_start, off * (method.between / reach))
