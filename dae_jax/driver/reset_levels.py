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
    changed: Scalar,
    rank: int | Rank | None,
    together: Scalar,
    found: Scalar,
    moved: Scalar,
    rtol: State,
    atol: State,
) -> Any:
    """The condition at the start of a part; where this is zero, the sign with which it leaves zero, forwards or, with `sign` −1,
    backwards, or 0 where it is not seen to leave. And what it is off by, and for how long it may not have left zero by as much.

    The sign is that of its rate after half the time that is `together`, from rest that of its first derivative that is not zero; the
    sign with which it came, −`before`, where its rate is not known. What a reset that has `changed` the state has brought to rest stays
    on the side `before` it, so that resets pile up where it is pulled through zero. Zero is what the condition moves by in that time,
    what may be round-off of the state in it, the value at which it was `found` to be zero, and, where it has `moved`, that and the error
    of the state: a reset that leaves it further off has put it there.
    """
    value = jnp.asarray(condition(t, y, args))
    # The state as it is: one made anew from the underlying ODE is NaN where the structure allows what the numbers do not.
    after = sign * together / 2
    z, decode, *flows = flow(system, t, y, args, rank, 2 * after)
    of = lambda t, z: jnp.asarray(condition(t, decode(t, z), args), t.dtype)
    points = (t, z), (t + after, jax.tree.map(lambda z, zd: z + after * zd, z, flows[1]))
    first, then = (jax.jvp(of, at, (jnp.ones_like(t), zd))[1] for at, zd in zip(points, flows, strict=True))
    rests = jnp.abs(first) < jnp.abs(then - first)
    side = jnp.where(jnp.isfinite(then), jnp.where(rests & (changed > 0), before, sign * jnp.sign(then)), -before)
    rate = jnp.where(jnp.isfinite(then), jnp.abs(then), 0)
    slopes = jax.tree.leaves(jax.grad(of, 1)(t, z))
    terms = sum(jnp.sum(jnp.abs(slope * x)) for slope, x in zip(slopes, jax.tree.leaves(z), strict=True))
    round_off = ROUND_OFF * jnp.finfo(t.dtype).eps * jnp.where(jnp.isfinite(terms), terms, 0)
    # Where the state had to be made consistent it is off by its error, and will be: algebraic unknowns included.
    error = error_of(condition, t, y, args, rtol, atol)
    inexact = moved > round_off
    off = jnp.where(inexact, 2 * moved + ERRORS * error, 0)
    # Where the condition jumps over zero, more was found.
    found = jnp.where(found <= error, found, 0)
    zero = rate * together + round_off + 2 * found + jnp.where(inexact, 2 * moved + error, 0)
    leaves = jnp.abs(value) <= zero
    level = jnp.where(leaves, side * zero, value)
    # From rest the error of the first steps outruns the condition.
    off = jnp.where(rests & (changed == 0), jnp.maximum(off, error), off)
    near = jnp.where(leaves, 2 * off / jnp.maximum(rate, jnp.finfo(t.dtype).tiny), 0)
    return lax.stop_gradient((level, off, near))


def error_of(condition: Callable[..., Time], t: Scalar, y: State, args: Args, rtol: State, atol: State) -> Scalar:
    """By how much the condition may be off where the state is so by its tolerances, in the structure of the state."""
    slopes = jax.grad(lambda y: jnp.asarray(condition(t, y, args), t.dtype))(y)
    off = lambda slope, x, rtol, atol: jnp.sum(jnp.abs(slope) * (rtol * jnp.abs(x) + atol))
    errors = jax.tree.map(off, slopes, y, rtol, atol)
    return sum(jax.tree.leaves(errors), jnp.zeros_like(t))
