"""How far a state is off the equations 0 = F(t, y, ẏ) and off the hidden ones, which are derivatives of F."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg import take
from ..systems import System
from ..types import Args, IntScalar, State, Time
from .linearised import LinearisedResidual
from .residual_form import ResidualForm
from .structural_ode import StructuralODE


# Gauss–Newton's method for the derivatives; equations that are linear in them take one.
CORRECTIONS = 10


class EquationDrift(NamedTuple):
    """The largest violation at each saved time, level by level: `levels[0]` of the equations themselves, `levels[k]` of their
    k-th derivatives, where these restrict y.
    """

    levels: tuple[Float[Array, " times"], ...]


def equation_drift(system: System, t: Time, state: State, args: Args) -> tuple[Float[Array, ""], ...]:
    """max |dᵏF/dtᵏ|, level by level, for the derivatives of y with which F = 0 holds best, and of these the ones with which
    dF/dt = 0 does, and so on: what is left of a level is what y itself violates.
    """
    form = ResidualForm.of(system, t, state, args)
    y = form.encode(state)
    t = jnp.asarray(t, y.dtype)
    linearised = LinearisedResidual.of(form, y)
    if not linearised.structure.hidden:
        return (jnp.max(jnp.abs(linearised.residual(t, y, linearised.ydot(t, y)))),)
    ode = StructuralODE.of(form, y.dtype, complete=1)
    if ode.sparse is not None:
        # All levels at once: the derivatives with which they are least together.
        return tuple(jnp.max(jnp.abs(level)) for level in ode.invariants(t, ode.start(t, y, None)))
    return tuple(jnp.max(jnp.abs(level)) for level in ode.invariants(t, _with_derivatives(ode, t, y)))


def _with_derivatives(ode: StructuralODE, t: Time, y: Float[Array, " n"]) -> Float[Array, " N"]:
    """The state of the underlying ODE whose values are y."""
    free = np.flatnonzero(ode.orders.values < 0)
    state = take(y, ode.orders.values)
    if not free.size:
        return state

    def correct(_: IntScalar, state: Float[Array, " N"]) -> Any:
        slopes, levels = ode.jacobian(t, state)[:, free], ode.invariants(t, state)
        step, open_directions, first = jnp.zeros(free.size, y.dtype), jnp.eye(free.size, dtype=y.dtype), 0
        for level in levels:
            rows = slopes[first : first + level.size]
            first += level.size
            largest = jnp.max(jnp.abs(rows), 1, keepdims=True)
            rows, off = (x / jnp.where(largest > 0, largest, 1) for x in (rows, level[:, None]))
            along = rows @ open_directions
            inverse = _pseudoinverse(along)
            step = step - open_directions @ (inverse @ (off[:, 0] + rows @ step))
            open_directions = open_directions - open_directions @ (inverse @ along)
        return state.at[free].add(step)

    return jax.lax.fori_loop(0, CORRECTIONS, correct, state)


@jax.custom_jvp
def _pseudoinverse(a: Float[Array, "m k"]) -> Float[Array, "k m"]:
    """That of a matrix whose rows were scaled to 1, so that what is small beside 1 is round-off."""
    u, sizes, v = jnp.linalg.svd(a, full_matrices=False)
    kept = sizes > jnp.finfo(a.dtype).eps ** 0.75
    return (v.T * jnp.where(kept, 1 / jnp.where(kept, sizes, 1), 0)) @ u.T


@_pseudoinverse.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # Of constant rank: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973), eq. 4.12. Vectors of equal singular values have no derivative.
    (a,), (da,) = primals, tangents
    inverse = _pseudoinverse(a)
    beside = inverse @ inverse.T @ (da - a @ (inverse @ da)).T
    open_ones = (da - (da @ inverse) @ a).T @ inverse.T @ inverse
    return inverse, beside + open_ones - inverse @ da @ inverse
