"""On which side of zero a condition is at the start of a part of a solve that a reset has divided."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from ..equations.constraint_jacobian import Rank
from ..equations.flow import flow
from ..systems import System
from ..types import Args, Scalar, State, Time, Y


# Of a condition's terms, in units of their last digit: what may be round-off of it.
ROUND_OFF = 1000
# By so many tolerances a condition may be off on its way off zero.
ERRORS = 100


class FromStart(eqx.Module):
    """± a condition whose value at the start is given, and is so for as long as it may be `off` by this."""

    condition: Callable[..., Any]
    sign: Any
    t0: Any
    level: Any
    off: Any
    near: Any

    def __call__(self, t: Time, y: Y, args: PyTree, **kwargs: object) -> Any:
        value = self.condition(t, y, args, **kwargs)
        unknown = (jnp.abs(value) <= self.off) & (jnp.abs(t - self.t0) <= self.near)
        return self.sign * jnp.where((t == self.t0) | unknown, self.level, value)


def level_at_start(
    system: System,
    condition: Callable[..., Time],
    sign: Scalar,
    t: Scalar,
    y: State,
    args: Args,
    before: Scalar,
    rank: int | Rank | None,
    together: Scalar,
    moved: Scalar,
    rtol: Scalar,
    atol: Scalar,
) -> Any:
    """The condition at the start of a part; where this is zero, the sign with which it leaves zero, forwards or, with `sign` −1,
    backwards. That is the sign with which it came, −`before`, where its rate is not known. Zero is what the condition moves by
    while times are `together`, what may be round-off of the state in it, and, where it has `moved`, what it is off by: that and the
    error of the state, relative to it and absolute. And what it is off by, and for how long it may not have left zero by as much.
    """
    value = jnp.asarray(condition(t, y, args))
    # The state as it is: one made anew from the underlying ODE is NaN where the structure allows what the numbers do not.
    z, decode, zd = flow(system, t, y, args, rank, together)
    of = lambda t, z: jnp.asarray(condition(t, decode(t, z), args), t.dtype)
    _, rate = jax.jvp(of, (t, z), (jnp.ones_like(t), zd))
    rate = jnp.where(jnp.isfinite(rate), sign * rate, -before)
    slopes = jax.tree.leaves(jax.grad(of, 1)(t, z))
    terms = sum(jnp.sum(jnp.abs(slope * x)) for slope, x in zip(slopes, jax.tree.leaves(z), strict=True))
    round_off = ROUND_OFF * jnp.finfo(t.dtype).eps * jnp.where(jnp.isfinite(terms), terms, 0)
    # Where the state had to be made consistent it is off by its error, and will be: algebraic unknowns included.
    by_state = jax.grad(lambda y: jnp.asarray(condition(t, y, args), t.dtype))(y)
    error = jax.tree.map(lambda slope, x: jnp.sum(jnp.abs(slope) * (rtol * jnp.abs(x) + atol)), by_state, y)
    off = jnp.where(moved > round_off, 2 * moved + ERRORS * sum(jax.tree.leaves(error)), 0)
    zero = jnp.abs(rate) * together + round_off + off
    leaves = (jnp.abs(value) <= zero) & (rate != 0)
    level = jnp.where(leaves, jnp.where(rate > 0, zero, -zero), value)
    near = jnp.where(leaves, 2 * off / jnp.where(leaves, jnp.abs(rate), 1), 0)
    return lax.stop_gradient((level, off, near))
