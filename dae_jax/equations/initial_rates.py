"""ẏ at the start of 0 = F(t, y, ẏ) where F is nonlinear in it."""

from typing import Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg import solve
from ..structure import is_linear
from ..types import DType, Flat, IntScalar, Scalar, Time
from .residual_form import LARGE, ResidualForm


# Where ẏ is looked for, besides the guess: in directions at random, at these distances from it.
DIRECTIONS, DISTANCES = 8, (0.1, 1.0, 10.0)
STEPS = 60
# Solutions that differ by more, relative to their size, are several.
APART = 1e-4


def is_nonlinear(form: object, dtype: DType) -> TypeGuard[ResidualForm]:
    """Whether F depends on ẏ other than linearly; what is large counts as linear, and is solved from what the user gave."""
    if not isinstance(form, ResidualForm) or not form.may_be_nonlinear or form.size > LARGE:
        return False
    time, y = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((form.size,), dtype)
    try:
        return not is_linear(form.residual, time, y, y, argument=2)
    except NotImplementedError:
        return False


def rates_of(form: ResidualForm, t: Time, y: Float[Array, " n"]) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """ẏ with F(t, y, ẏ) = 0, or with the least F, by the Levenberg–Marquardt method from the form's guess; where the user
    gave none, from others also, and whether these led to different solutions.

    Source: J. Nocedal, S. J. Wright, *Numerical Optimization*, 2nd ed., section 10.3.
    """
    guess = form.known_ydot(y)
    if form.rates_are_given:
        return _nearest(form, t, y, guess)[0], jnp.asarray(False)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(DIRECTIONS, form.size)) / np.sqrt(form.size)
    aside = jnp.asarray(np.concatenate([np.zeros((1, form.size)), *(size * directions for size in DISTANCES)]), y.dtype)
    eps = jnp.finfo(y.dtype).eps
    # What F is without ẏ, a part of which is round-off of it, in any unit.
    at_guess = jnp.sqrt(jnp.sum(form.residual(t, y, guess) ** 2))

    def fits(left: Array, reach: Array) -> Array:
        # Where F overflows nothing was found.
        left = jnp.where(jnp.isfinite(left) & jnp.isfinite(reach), left, jnp.inf)
        return jnp.isfinite(left) & (left <= eps**0.75 * (at_guess + reach) + 2 * jnp.min(left))

    def look(around: tuple[Flat, Flat], _: None) -> Any:
        centre, unit = around
        found, left, reach = jax.vmap(lambda offset: _nearest(form, t, y, centre + offset))(aside * unit)
        best = found[jnp.argmax(fits(left, reach))]
        # As large as what was found: an entry in a unit of its own.
        largest = jnp.max(jnp.abs(best))
        unit = jnp.where(best != 0, jnp.abs(best), jnp.where(largest > 0, largest, 1))
        return (best, unit), (found, left, reach, jnp.max(jnp.abs(aside * around[1]), 1))

    # From the guess, in units of 1/s; and once more in those of what was found there.
    _, seen = jax.lax.scan(look, (guess, jnp.ones_like(guess)), None, 2)
    found, left, reach, distance = (x.reshape(-1, *x.shape[2:]) for x in seen)
    solved = fits(left, reach)
    first = found[jnp.argmax(solved)]
    # Of variables whose derivative does not occur the guess is kept, offset and all.
    slopes = jnp.abs(jax.jacfwd(form.residual, 2)(t, y, first))
    occurs = jnp.max(slopes, 0) > 0
    moved, sizes = jnp.abs(found - first), jnp.maximum(jnp.abs(found), jnp.abs(first))
    # What the search, from that distance, may have left.
    noise = eps**0.4 * (jnp.max(jnp.abs(first)) + distance)[:, None]
    several = jnp.any(solved[:, None] & occurs & (moved > APART * sizes) & (moved > noise))
    return jnp.where(occurs, first, guess), several


def _nearest(
    form: ResidualForm, t: Time, y: Flat, start: Flat
) -> tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]]:
    """Where F is least near a start, its size there, and that of the terms with ẏ in it."""
    eye = jnp.eye(form.size, dtype=y.dtype)
    size = lambda r: jnp.sum(r * r)

    def improve(_: IntScalar, carry: tuple[Flat, Scalar]) -> Any:
        yd, damping = carry
        r, slopes = form.residual(t, y, yd), jax.jacfwd(form.residual, 2)(t, y, yd)
        normal = jnp.sum(slopes[:, :, None] * slopes[:, None, :], 0)
        least = jnp.finfo(y.dtype).eps * jnp.trace(normal) + jnp.finfo(y.dtype).tiny
        step = solve(normal + (damping * jnp.trace(normal) + least) * eye, jnp.sum(slopes * r[:, None], 0))
        better = size(form.residual(t, y, yd - step)) < size(r)
        return jnp.where(better, yd - step, yd), jnp.where(better, damping / 10, jnp.minimum(10 * damping, 1e12))

    yd, _ = jax.lax.fori_loop(0, STEPS, improve, (start, jnp.asarray(1e-3, y.dtype)))
    terms = jnp.sum(jnp.abs(jax.jacfwd(form.residual, 2)(t, y, yd) * yd), 1)
    return yd, jnp.sqrt(size(form.residual(t, y, yd))), jnp.sqrt(size(terms))
