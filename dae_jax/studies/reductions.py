"""What to keep of a solve in a sweep: numbers, so that memory does not grow with the steps; of a batch within `vmap`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PyTree

from ..compiler import at_ease
from ..diagnostics import drift, energy
from ..driver.felt_steps import OneDirection
from ..equations.consistent_change import consistent_change
from ..solution import RESULTS, DAESolution
from ..solve import daesolve
from ..systems import ConstrainedSystem, System
from ..types import Args, Solver, State, Time
from ..validate.captured import current
from ..validate.closures import opened
from ..validate.states import as_floats, broadcast_to_state, describe, refuse_wrong_state


def final_state(sol: DAESolution) -> Any:
    """The last saved state; also `sol.final`."""
    return sol.final


def largest_drift(system: System, sol: DAESolution) -> Float[Array, ""]:
    """The largest of the levels of `drift` over the saved times, max |(g, ġ, h)| of a mechanism; infinite where the solve failed."""
    return _where_it_went_well(sol, jnp.max(jnp.stack(drift(system, sol).levels)), jnp.inf)


def energy_error(system: ConstrainedSystem, sol: DAESolution) -> Float[Array, ""]:
    """max |E(t) − E(t₀)| over the saved times, in the unit of the energy, t₀ the first of them; infinite where the solve failed.

    Errors: `ValueError` for one saved time, at which there is nothing to compare with.
    """
    total = energy(system, sol)
    if total.shape[-1] == 1:
        raise ValueError(
            "`energy_error` compares the saved times with the first of them, and there is one: save more, "
            "`saveat=diffrax.SaveAt(ts=...)` or `SaveAt(t0=True, t1=True)`."
        )
    return _where_it_went_well(sol, jnp.max(jnp.abs(total - total[0])), jnp.inf)


def largest_error(sol: DAESolution, reference: State) -> Float[Array, ""]:
    """max |y − reference| over the saved times, infinite where the solve failed; `reference` has the structure of `sol.ys`.

    Errors: `ValueError` for a reference of another structure or other shapes.
    """
    _refuse_batch(sol)
    if jax.tree.map(jnp.shape, sol.ys) != jax.tree.map(jnp.shape, reference):
        raise ValueError(
            f"`reference` must have the structure and the shapes of `sol.ys`, {describe(sol.ys)}, but is {describe(reference)}."
        )

    def largest(y: State, r: State) -> Any:
        saved = jnp.isfinite(sol.ts).reshape(-1, *(1,) * (y.ndim - 1))
        return jnp.max(jnp.where(saved, jnp.abs(y - r), 0))

    error = jnp.max(jnp.stack(jax.tree.leaves(jax.tree.map(largest, sol.ys, reference))))
    return _where_it_went_well(sol, error, jnp.inf)


def first_time(ts: Float[Array, " times"], happened: Bool[Array, " times"]) -> Float[Array, ""]:
    """The first of the times at which something has happened, in the order of the solve, forwards or backwards; infinite where it
    has not.
    """
    return jnp.where(jnp.any(happened), ts[jnp.argmax(happened)], jnp.inf)


def first_flip(ts: Float[Array, " times"], arm: Float[Array, "times 2"]) -> Float[Array, ""]:
    """When an arm (x, y), y down, first turns over the top: its angle, followed from saved time to saved time, leaves
    (−π, π). Infinite where it does not; late by at most the distance of the saved times, which must be short beside the
    time of half a turn.
    """
    angle = jnp.unwrap(jnp.arctan2(arm[:, 0], arm[:, 1]))
    return first_time(ts, jnp.abs(angle) >= jnp.pi)


@at_ease
def lyapunov(
    system: ConstrainedSystem,
    solver: Solver,
    t0: Time,
    t1: Time,
    y0: State,
    args: Args = None,
    *,
    direction: State = None,
    **options: Any,
) -> Float[Array, ""]:
    """The finite-time Lyapunov exponent, log(|δy(t₁)| / |δy(t₀)|) / (t₁ − t₀), in 1/s.

    δy is the derivative of the solution (tangent dynamics, by `jax.jvp`) in one direction, which is made consistent with
    the constraints and the hidden ones: `direction`, with the structure of `y0`, by default 1 everywhere. `options` are
    those of `daesolve`, but for `event`, `saveat` and `adjoint`. Steps are chosen for δy as for the solution. NaN where a solve with
    `throw=False` failed, where the direction is zero once it is consistent, where δy is too large or too small for a number, and where
    times within `jit` leave no time.
    Derivatives of the exponent are found in forward mode (`jax.jacfwd`).

    Errors: `TypeError` for one of these three; `ValueError` for a direction of another structure, and for t0 = t1.
    """
    for name in ("event", "saveat", "adjoint"):
        if name in options:
            raise TypeError(f"`lyapunov` takes no `{name}`: the exponent is that of the whole time from t0 to t1.")
    if not any(isinstance(t, Tracer) for t in (t0, t1)) and t0 == t1:
        raise ValueError(f"An exponent is found over a time, and from t0 = {t0} to t1 = {t1} there is none.")
    refuse_wrong_state(system, y0)
    y0 = as_floats(y0)
    along = jax.tree.map(jnp.ones_like, y0)
    if direction is not None:
        along = broadcast_to_state("direction", direction, y0, "numbers")
    start = _consistent_change(*opened(current((system, t0, y0, as_floats(along), args))))

    def end(y: State) -> tuple[Any, DAESolution]:
        sol = daesolve(
            system, solver, t0, t1, options.get("dt0"), y, args, adjoint=OneDirection(),
            **{name: value for name, value in options.items() if name != "dt0"},
        )  # fmt: skip
        return sol.final, sol

    _, last, sol = jax.jvp(end, (y0,), (start,), has_aux=True)
    time = jnp.where(t0 == t1, jnp.nan, jnp.asarray(t1) - t0)
    return _where_it_went_well(sol, jnp.log(_norm(last) / _norm(start)) / time, jnp.nan)


_consistent_change = eqx.filter_jit(consistent_change)


def _where_it_went_well(sol: DAESolution, value: Float[Array, ""], otherwise: float) -> Float[Array, ""]:
    _refuse_batch(sol)
    went_well = (sol.result == RESULTS.successful) | (sol.result == RESULTS.event_occurred)
    return jnp.where(went_well, value, otherwise)


def _refuse_batch(sol: DAESolution) -> None:
    """Lanes have a number each, which `vmap` gives."""
    if jnp.ndim(sol.t0):
        raise ValueError("This is a number of one solution, and the one given is a batch: call it within `jax.vmap`.")


def _norm(tree: PyTree) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(tree)))
