"""What of a change of a consistent state keeps it consistent."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
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


def consistent_change(system: System, t: Time, y: State, change: State, args: Args, of_numbers: Any = None) -> Any:
    """The change δy nearest to `change` with which y + δy satisfies the equations and the hidden ones to first order: the derivative of
    `dae_jax.consistent_state` at a state that is consistent.

    `of_numbers`: the changes of the inexact arrays in (system, args), where these change too.
    """
    numbers, others = eqx.partition((system, args), eqx.is_inexact_array)

    def push(of: Callable[[Any, Args], Any]) -> Any:
        """The change of a function of the system and `args`."""
        if of_numbers is None:
            return 0.0
        return jax.jvp(lambda numbers: of(*eqx.combine(numbers, others)), (numbers,), (of_numbers,))[1]

    if is_mechanism(system):
        return _of_mechanism(system, t, y, change, args, push)
    form = ResidualForm.of(system, t, y, args)
    values, wanted = form.encode(y), form.encode(change)
    t = jnp.asarray(t, values.dtype)
    ode = StructuralODE.of(form, values.dtype, complete=1)
    at = ode.encode(t, y)
    is_value = ode.orders.values >= 0
    aim = jnp.where(is_value, take(wanted, ode.orders.values), 0)
    a = ode.jacobian(t, at)
    of_form = lambda system, args: dataclasses.replace(ode, form=ResidualForm.of(system, t, y, args)).violations(t, at)
    found = aim + step_to(
        a,
        jnp.sum(a * aim, 1) + push(of_form),
        jnp.asarray(np.where(is_value, 1, FREE), aim.dtype),
        jnp.asarray(~is_value),
    )
    return jax.jvp(lambda y: ode.decode(t, y), (at,), (found,))[1]


def _of_mechanism(
    system: Any, t: Time, y: State, change: State, args: Args, push: Callable[[Callable[[Any, Args], Any]], Any]
) -> Any:
    """δq with which g, and δv with which (ġ, h) stays 0."""
    ode = MechanicalODE.of(system, t, y, args)
    (q, v), (dq, dv) = ode.encode(y), ode.encode(change)
    a, mass, free = ode.constraint_jacobian(t, q, v), ode.mass(q), jnp.ones_like(q)
    if m := ode.holonomic:
        off = push(lambda system, args: MechanicalODE.of(system, t, y, args).constraint(t, q))
        dq = dq - shortest(a[:m], mass, free, jnp.dot(a[:m], dq) + off)
    _, off = jax.jvp(lambda q, v: ode.velocity_constraint(t, q, v), (q, v), (dq, dv))
    off = off + push(lambda system, args: MechanicalODE.of(system, t, y, args).velocity_constraint(t, q, v))
    return ode.decode(t, (dq, dv - shortest(a, mass, free, off)))
