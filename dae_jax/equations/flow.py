"""Where a state moves: the derivatives of all its variables, those that occur in no equation among them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from ..systems import System, is_mechanism
from ..types import Args, State, Time, Y
from .constraint_jacobian import Rank
from .linearised import LinearisedResidual
from .residual_form import LARGE, ResidualForm
from .structural_ode import underlying_ode


# Corrections of ẏ after h/2: so many derivatives of y beyond the first may be zero at the start of a motion that is seen.
ORDERS = 3


def flow(
    system: System, t: Time, state: State, args: Args, rank: int | Rank | None, h: Time
) -> tuple[Y, Callable[[Time, Y], State], Y, Y]:
    """y, what makes a state of one, and ẏ at a consistent state, there and after `h`/2.

    ẏ is that of the underlying ODE. Of a large system that would be dense, and ẏ is, for both, (y₁ − y)/h after one step of the
    implicit Euler method, (J + M/h)(y₁ − y) = M ẏ₀ − F(t + h, y, ẏ₀), which gives algebraic variables of index 1 theirs also; NaN
    where it has hidden equations. `h` is short beside all that moves: no number of seconds is.
    """
    if is_mechanism(system) or sum(jnp.size(x) for x in jax.tree.leaves(state)) <= LARGE:
        y, ode = underlying_ode(system, t, state, args, rank)
        along = lambda yd: jax.tree.map(lambda y, yd: y + h / 2 * yd, y, yd)
        yd = ode.field(t, y)
        return y, ode.decode, yd, lax.fori_loop(0, ORDERS, lambda _, yd: ode.field(t + h / 2, along(yd)), yd)
    form = ResidualForm.of(system, t, state, args)
    y: Any = form.encode(state)
    linearised = LinearisedResidual.of(form, y)
    if linearised.structure.hidden:
        unknown = jnp.full_like(y, jnp.nan)
        return y, form.decode, unknown, unknown
    h = jnp.asarray(h, y.dtype)
    yd = linearised.ydot(t, y)
    j, m = linearised.jacobians(t, y, yd)
    off = linearised.storage.apply(m, yd) - linearised.residual(t + h, y, yd)
    mean = linearised.solve(linearised.factor(j, m, 1 / h, h), off) / h
    return y, form.decode, mean, mean
