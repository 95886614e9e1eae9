"""The error of a step as the derivative of a solve sees it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from ..types import BoolScalar, Y


# A derivative may have an error so many times the tolerance, relative to its largest entry.
ALLOWED = 10


@jax.custom_jvp
def felt(error: Y, y0: Y, y1: Y, counts: BoolScalar, rtol: Any, atol: Any) -> Y:  # noqa: ARG001
    """The error of a step from y₀ to y₁. Under forward derivatives it is, where that is more and `counts`,
    δerror (s + |y|) / (ALLOWED |δy|), s = min(1, atol/rtol): of an absolute tolerance that is small beside the relative one, for
    variables that are small, a derivative knows nothing.
    """
    return error


@felt.defjvp
def _(primals: tuple[Y, Y, Y, BoolScalar, Any, Any], tangents: tuple[Y, Y, Y, Any, Any, Any]) -> Any:
    error, y0, y1, counts, rtol, atol = primals
    least = jnp.minimum(1, atol / jnp.asarray(rtol))
    largest = lambda *trees: jnp.max(jnp.stack([jnp.max(jnp.abs(x), initial=0.0) for x in jax.tree.leaves(trees)]))
    size = largest(tangents[1], tangents[2])
    relative = 1 / (ALLOWED * jnp.where(size > 0, size, 1))

    def larger(error: Any, change: Any, before: Any, after: Any) -> Any:
        of_change = jnp.abs(change) * relative * (least + jnp.maximum(jnp.abs(before), jnp.abs(after)))
        return lax.stop_gradient(jnp.where(counts & (of_change > jnp.abs(error)), of_change, error))

    found = jax.tree.map(larger, error, tangents[0], y0, y1)
    return found, jax.tree.map(jnp.zeros_like, found)
