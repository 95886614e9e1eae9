"""The rates of what a solver of residuals shows to the user, those of algebraic variables among them."""

from typing import Any

import jax
import jax.numpy as jnp

from ..systems import is_mechanism
from ..types import Flat, Time
from .index1_form import Index1Form
from .linearised import LinearisedResidual
from .mechanical import MechanicalODE
from .raised_index import raised_rates
from .residual_form import accelerations
from .structural_ode import underlying_ode


def shown_rates(t: Time, y: Flat, equations: LinearisedResidual, raised: bool = False) -> Any:
    """ẏ of the unknowns that `decode` looks at, by the equations and their derivatives; 0 of the others. `raised`: whether the index may
    be higher than the structure has it.
    """
    form = equations.form
    if isinstance(form, Index1Form):
        t, states = jnp.asarray(t, y.dtype), y[: form.ode.orders.size]
        return jax.jvp(form.encode, (t, states), (jnp.ones_like(t), form.ode.field(t, states)))[1]
    state = form.decode(t, y)
    if is_mechanism(form.system):
        ode = MechanicalODE.of(form.system, t, state, form.args)
        q, v = ode.encode(state)
        return form.encode(ode.decode(t, (v, accelerations(ode, t, (q, v)))))
    t = jnp.asarray(t, y.dtype)
    if raised:
        return raised_rates(form, t, y)
    at, ode = underlying_ode(form.system, t, state, form.args)
    return form.encode(jax.jvp(ode.decode, (t, at), (jnp.ones_like(t), ode.field(t, at)))[1])
