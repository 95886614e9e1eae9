"""Which entries of the state of an underlying ODE its invariants determine, given the others, and for how long."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg import determinant_sign, row_products, take
from ..types import IntScalar, Scalar
from .orders import Orders


# A selection of states is kept until its smallest pivot is less than this part of the best one's.
HYSTERESIS = 0.3
# It is to be good for so many steps of the present size.
STEPS = 100


def selection(
    orders: Orders,
    leading: Float[Array, "n n"],
    chosen: Float[Array, "m N"] | None = None,
    ahead: Float[Array, "n n"] | None = None,
) -> tuple[Float[Array, "m N"], Bool[Array, ""]]:
    """Unit directions of the dummy derivatives, entries of Y that H = 0 determines given the others, and whether they
    are not `chosen`.

    Level by level, from the highest: the equations with Cᵢ ≥ k determine the derivatives of order Dⱼ − k of as many
    variables, taken by complete pivoting on the `leading` matrix from those that the level before has taken; on entries
    first that are about the same in that `ahead`, a step later.
    """
    d = np.array(orders.variables)
    largest = jnp.max(jnp.abs(leading), 1, keepdims=True)
    matrix = leading if ahead is None else lasting(leading, ahead)
    matrix = matrix / jnp.where(largest > 0, largest, 1)
    infinite = jnp.asarray(jnp.inf, matrix.dtype)
    available, quality, present, first, directions = jnp.ones(len(d), matrix.dtype), infinite, infinite, 0, []
    for k in range(1, max(orders.equations) + 1):
        rows = orders.rows(k - 1)
        place = orders.dummies(k)
        level = matrix[rows] * (d >= k)
        taken, smallest = _pivots(level * available)
        quality, available = jnp.minimum(quality, smallest), jnp.sum(taken, 0)
        embedding = np.zeros((len(d), orders.size))
        embedding[place >= 0, place[place >= 0]] = 1
        directions.append(jnp.sum(taken[:, :, None] * jnp.asarray(embedding, taken.dtype), 1))
        if chosen is not None:
            _, smallest = _pivots(level * take(jnp.sum(chosen[first : first + len(rows)], 0), place))
            present = jnp.minimum(present, smallest)
        first += len(rows)
    best = jnp.concatenate(directions) if directions else jnp.zeros((0, orders.size), matrix.dtype)
    if chosen is None or not directions:
        return best, jnp.asarray(False)
    keep = present >= HYSTERESIS * quality
    return jnp.where(keep, chosen, best), ~keep


def orientation(orders: Orders, leading: Float[Array, "n n"], chosen: Float[Array, "m N"]) -> Float[Array, " levels"]:
    """The sign, level by level, of the determinant with which H = 0 determines the `chosen` dummy derivatives: it changes
    only where these become undetermined.
    """
    first, signs = 0, []
    for k in range(1, max(orders.equations) + 1):
        rows, place = orders.rows(k - 1), orders.dummies(k)
        directions = chosen[first : first + len(rows)]
        columns = jnp.where(jnp.asarray(place >= 0), directions[:, np.maximum(place, 0)], 0)
        signs.append(determinant_sign(row_products(leading[rows], columns)))
        first += len(rows)
    return jnp.stack(signs)


def lasting(start: Float[Array, "n n"], end: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The entries of a matrix at a step's start, those less that change within some such steps: of an unknown in a large unit an entry
    is large beside others until just before it is 0. Entries that are not known at the predicted end stay.
    """
    size, change = jnp.abs(start), STEPS * jnp.abs(end - start)
    part = size / jnp.where(size > 0, size + change, 1)
    return start * jnp.where(jnp.isnan(part), 1, part) ** 4


def _pivots(a: Float[Array, "m N"]) -> tuple[Float[Array, "m N"], Float[Array, ""]]:
    """The columns that elimination with complete pivoting takes, as unit rows, and the smallest pivot."""
    m, n = a.shape

    def eliminate(k: IntScalar, carry: tuple[Float[Array, "m N"], Float[Array, "m N"], Scalar]) -> Any:
        a, taken, smallest = carry
        place = jnp.argmax(jnp.abs(a).reshape(-1))
        at_row, at_column = (jnp.arange(m) == place // n)[:, None], jnp.arange(n) == place % n
        row = jnp.sum(jnp.where(at_row, a, 0), 0)
        column = jnp.sum(jnp.where(at_column, a, 0), 1, keepdims=True)
        pivot = jnp.sum(jnp.where(at_column, row, 0))
        reduced = a - column * (row / jnp.where(pivot == 0, 1, pivot))
        a = jnp.where(at_row | at_column, 0, reduced)
        taken = jnp.where((jnp.arange(m) == k)[:, None], jnp.where(at_column, 1, 0).astype(a.dtype), taken)
        return a, taken, jnp.minimum(smallest, jnp.abs(pivot))

    infinite = jnp.asarray(jnp.inf, a.dtype)
    _, taken, smallest = lax.fori_loop(0, m, eliminate, (a, jnp.zeros_like(a), infinite))
    return taken, smallest
