"""The point of a manifold that is nearest to a given one, however far off and however curved."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg import relative_change, roundoff
from ..types import Flat, Scalar


STEPS = 300
# Steps that would have to be shorter lead nowhere.
SHORTEST = 2.0**-20
# By what a step onto the manifold shortens the next one where the linearisation says how far off a point is.
QUICK = 0.3
# More than 1, so that the merit is least on the manifold.
PENALTY = 3.0
# A start that is off is moved aside by this part of that, lest symmetry keep it on the way to a farthest point.
ASIDE = 1e-3


def nearest_point(
    linearised: Callable[[Float[Array, " n"], Float[Array, " n"]], Float[Array, " n"]],
    start: Float[Array, " n"],
    aims: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    inner: Callable[[Float[Array, " n"], Float[Array, " n"]], Float[Array, ""]],
    movable: Bool[Array, " n"] | Bool[np.ndarray, " n"],
    diagonal: Float[Array, " n"] | None = None,
    begin: Float[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    """y on the manifold H(y) = 0 at the least distance from `start`, by Gauss–Newton steps.

    `linearised(y, aim)` is the point next to `aim` on the linearisation of H = 0 at y, `aims(y)` what y is to be near to, and
    |x|² = `inner(x, x)`, in which what is not measured does not occur; `movable` is what is measured and free; `diagonal`, that of
    the inner product, says how far it is in an entry's own unit; `begin`: where to begin, if not at `start`.

    First onto the manifold. Then a step is as long as makes the merit |y − start| + 3 |A⁺H| less, whose second term is about
    how far y is from the manifold: by the triangle inequality no point off the manifold has less than the nearest one. Full
    steps converge only where the distance is less than the radius of curvature; their length is therefore the inverse of
    the slope that was seen in the last one (J. Barzilai, J. M. Borwein, IMA J. Numer. Anal. 8 (1988), 141–148), 1 at most.
    """
    length = lambda x: jnp.sqrt(inner(x, x))

    def look(y: Flat, left: Scalar, arrived: Bool[Array, ""]) -> tuple[Flat, Scalar, Scalar, Bool[Array, ""]]:
        near, onto = jax.vmap(lambda aim: linearised(y, aim))(jnp.stack([aims(y), y]))
        before, left = left, length(onto - y)
        arrived = arrived | (left <= QUICK * before)
        return jnp.where(arrived, near, onto) - y, length(y - start) + PENALTY * left, left, arrived

    def step(carry: Any) -> Any:
        y, way, merit, left, arrived, part, count = carry
        off = jnp.max(jnp.abs(jnp.where(movable, way, 0)), initial=0)
        # In units of its own: where an entry is 0 the metric has them, and a way of kilometres is none of a quaternion.
        far = off if diagonal is None else jnp.where(diagonal > 0, length(way) / jnp.sqrt(diagonal), off)
        reach = jnp.minimum(jnp.where(y == 0, far, jnp.abs(y)), off)
        aside = jnp.where((count == 1) & movable & (off > noise), ASIDE * reach * directions, 0)
        trial = y + part * way + aside
        new = look(trial, left, arrived)
        # Near the end differences of the merit are round-off, and ways get shorter.
        level = (new[1] - merit <= noise * merit) & (size(new[0], trial) <= size(way, y))
        better = jnp.isfinite(new[1]) & ((new[1] <= merit) | level | ~arrived)
        moved, turned = trial - y, way - new[0]
        inverse = inner(moved, moved) / inner(moved, turned)
        longer = jnp.where((inverse > 0) & arrived, jnp.minimum(inverse, 1), 1)
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (trial, *new, longer), (*carry[:5], part / 2))
        return *kept, count + 1

    def unfinished(carry: Any) -> Bool[Array, ""]:
        y, way, _, _, _, part, count = carry
        return (count == 0) | (size(way, y) > roundoff(y.dtype)) & (part > SHORTEST) & (count < STEPS)

    size, noise = relative_change, roundoff(start.dtype) ** 0.5
    directions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, start.shape), start.dtype)
    one = jnp.ones((), start.dtype)
    first = start if begin is None else begin, jnp.zeros_like(start), one * jnp.inf, 0 * one, jnp.asarray(False), one, 0
    return lax.while_loop(unfinished, step, first)[0]


def finite_start(
    violations: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    start: Float[Array, " n"],
    movable: Bool[Array, " n"] | Bool[np.ndarray, " n"],
) -> Float[Array, " n"]:
    """`start`, or nearer to 0 by a power of 2, in what is `movable`, where an exponential does not overflow."""
    shrunk = lambda part: jnp.where(movable, part * start, start)
    is_finite = lambda part: jnp.all(jnp.isfinite(violations(shrunk(part))))
    goes_on = lambda part: ~is_finite(part) & (part > SHORTEST)
    part = lax.while_loop(goes_on, lambda part: part / 2, jnp.ones((), start.dtype))
    return jnp.where(is_finite(part), shrunk(part), start)
