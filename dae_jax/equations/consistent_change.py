"""What of a change of a consistent state keeps it consistent."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..linalg import take
from ..systems import System, is_mechanism
from ..types import Args, State, Time
from .constraint_jacobian import shortest
from .mechanical import MechanicalODE
from .nearest_step import step_to
from .residual_form import ResidualForm
from .sparse_invariants import FREE
from .structural_ode import StructuralODE


def consistent_change(system: System, t: Time, y: State, change: State, args: Args) -> Any:
    """The change δy nearest to `change` with which y + δy satisfies the equations and the hidden ones to first order: the derivative of
    `dae_jax.consistent_state` at a state that is consistent.
    """
    if is_mechanism(system):
        return _of_mechanism(MechanicalODE.of(system, t, y, args), t, y, change)
    form = ResidualForm.of(system, t, y, args)
    values, wanted = form.encode(y), form.encode(change)
    t = jnp.asarray(t, values.dtype)
    ode = StructuralODE.of(form, values.dtype, complete=True)
    at = ode.encode(t, y)
    is_value = ode.orders.values >= 0
    aim = jnp.where(is_value, take(wanted, ode.orders.values), 0)
    a = ode.normals(t, at)
    found = aim + step_to(a, jnp.sum(a * aim, 1), jnp.asarray(np.where(is_value, 1, FREE), aim.dtype), ~is_value)
    return jax.jvp(lambda y: ode.decode(t, y), (at,), (found,))[1]


def _of_mechanism(ode: MechanicalODE, t: Time, state: State, change: State) -> Any:
    """δq with G δq = 0, and δv with which (ġ, h) stays 0."""
    (q, v), (dq, dv) = ode.encode(state), ode.encode(change)
    a, mass, free = ode.constraint_jacobian(t, q, v), ode.mass(q), jnp.ones_like(q)
    if m := ode.holonomic:
        dq = dq - shortest(a[:m], mass, free, jnp.dot(a[:m], dq))
    _, off = jax.jvp(lambda q, v: ode.velocity_constraint(t, q, v), (q, v), (dq, dv))
    return ode.decode(t, (dq, dv - shortest(a, mass, free, off)))
