"""What a solution does with its constraints, its energy and its multipliers."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .constraints import MechanicalODE
from .solution import DAESolution
from .systems import ConstrainedSystem


class Drift(NamedTuple):
    """The largest violation at each saved time: `position` is max |g|, `velocity` max |(ġ, h)|."""

    position: Float[Array, " times"]
    velocity: Float[Array, " times"]


def drift(system: ConstrainedSystem, sol: DAESolution) -> Drift:
    """How far each saved state is off the constraints, and off their first derivative."""

    def largest(t: Any, y: Any) -> tuple[Any, Any]:
        ode = MechanicalODE.of(system, t, y, sol.args)
        g, dg = ode.invariants(t, ode.encode(y))
        return jnp.max(jnp.abs(g), initial=0), jnp.max(jnp.abs(dg), initial=0)

    return Drift(*jax.vmap(largest)(sol.ts, sol.ys))


def energy(system: ConstrainedSystem, sol: DAESolution) -> Float[Array, " times"]:
    """½ vᵀM v + V(q) at each saved time.

    Errors: `ValueError` where the system has no `potential`.
    """
    if system.potential is None:
        raise ValueError("The energy needs `ConstrainedSystem(..., potential=lambda q, args: ...)`.")
    potential = system.potential

    def total(q: Any, v: Any) -> Any:
        ode = MechanicalODE.of(system, 0.0, (q, v), sol.args)
        flat_q, flat_v = ode.encode((q, v))
        mass = ode.mass(flat_q)
        momentum = flat_v if mass is None else mass * flat_v if mass.ndim < 2 else jnp.dot(mass, flat_v)
        return jnp.dot(flat_v, momentum) / 2 + potential(q, sol.args)

    return jax.vmap(total)(*sol.ys)


def multipliers(system: ConstrainedSystem, sol: DAESolution) -> Float[Array, "times mp"]:
    """(λ, μ) at each saved time: the constraint forces are −Gᵀλ − Hᵀμ. Of least norm where constraints are redundant."""

    def at(t: Any, y: Any) -> Any:
        ode = MechanicalODE.of(system, t, y, sol.args, sol.rank)
        return ode.multipliers(t, ode.encode(y))

    return jax.vmap(at)(sol.ts, sol.ys)
