"""Equations whose index is higher than their structure has it, by one, for the numbers at hand: a switch 0 = s z + (1 − s) x, with s = 0,
takes from z the equation that the structure gives it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg import take
from ..systems import System
from ..types import Args, State, Time
from .nearest_step import step_to
from .residual_form import LARGE, ResidualForm
from .sparse_invariants import FREE
from .structural_ode import StructuralODE


# How often more than their structure says equations are differentiated for the values, and for the rates, of all variables.
FOR_VALUES, FOR_RATES = 2, 3
# A rate that is not determined does not come back with so many digits.
LOST = 1e-3


def may_be_raised(system: System, t: Time, state: State, args: Args) -> bool:
    """Whether other numbers in `args`, which are traced, may raise the index of a system that is no mechanism and not large: whether the
    matrix of the equations for the highest derivatives depends on anything.
    """
    form = ResidualForm.of(system, t, state, args)
    return form.size <= LARGE and bool(StructuralODE.of(form, jnp.result_type(*jax.tree.leaves(state))).varying)


def raised_rates(form: ResidualForm, t: Time, y: Float[Array, " n"]) -> Float[Array, " n"]:
    """ẏ at a consistent y, from F and its derivatives F', F″, … all at once; NaN where these do not determine it.

    Source: S. L. Campbell, C. W. Gear, The index of general nonlinear DAEs, Numer. Math. 72 (1995), 173–196.
    """
    ode = StructuralODE.of(form, y.dtype, complete=FOR_RATES)
    found = ode.start(t, y, jnp.ones_like(y), near=True)
    places = ode.orders.places[1]
    a = ode.jacobian(t, found)
    is_value = np.asarray(ode.orders.values) >= 0
    probe = jnp.asarray(np.where(is_value, 0, 1 + np.arange(len(is_value)) % 7), y.dtype)
    again = step_to(
        a, -jnp.sum(a * probe, 1), jnp.asarray(np.where(is_value, 0, FREE), y.dtype), jnp.asarray(~is_value)
    )
    fine = jnp.all(jnp.abs(take(again - probe, places)) < LOST)
    # A factor, so that the derivative is not known either.
    return take(found, places) * jnp.where(fine, 1.0, jnp.nan)
