"""Whether a matrix determines its unknowns, and whether it still does for equations that have changed, by whether it finds one
vector again.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..types import Flat


# A vector that comes back off by more than ε to this power has no digits to speak of. An unknown that is off by more than ε to
# that power at first counts as much less as in its own scale.
LOST, RAISED = 0.2, 0.8
# What is left of the vector after so many corrections by the matrix of other equations.
LEFT, CORRECTIONS = 0.1, 5


class Probe(NamedTuple):
    """A vector r that is anything, and whether A⁻¹ A r has digits of it: `determined`.

    The error is about |A⁻¹| |A| |r| ε, whatever the scales of rows are: a matrix that is singular to round-off has lost r, one
    with a small pivot, as different units and sizes make it, has not.

    Source: N. J. Higham, *Accuracy and Stability of Numerical Algorithms*, sec. 7.2.
    """

    vector: Float[Array, " n"]
    determined: Bool[Array, ""]

    @classmethod
    def of(cls, apply: Callable[[Flat], Flat], solve: Callable[[Flat], Flat], scale: Float[Array, " n"]) -> "Probe":
        """That of x ↦ A x and A⁻¹ x, for unknowns of that `scale`."""
        pattern, epsilon = jnp.asarray(_pattern(scale.size), scale.dtype), float(jnp.finfo(scale.dtype).eps)
        first = lax.stop_gradient(scale) * pattern
        off = jnp.abs(solve(apply(first)) - first)
        vector = pattern * jnp.maximum(jnp.abs(first), off * epsilon**-RAISED)
        return cls(vector, _is_within(epsilon**LOST, solve(apply(vector)) - vector, vector))

    def determines(self, solve: Callable[[Flat], Flat], residual: Callable[[Flat], Flat], x: Flat) -> Bool[Array, ""]:
        """Whether corrections by A⁻¹ find the vector r again from B r, where B is the derivative of the residual at x. Where B
        is singular they never find what it makes 0, also where A is not and the residual itself is 0.
        """

        def correct(carry: tuple[Flat, Array]) -> tuple[Flat, Array]:
            left, count = carry
            return left - solve(jax.jvp(residual, (x,), (left,))[1]), count + 1

        def goes_on(carry: tuple[Flat, Array]) -> Bool[Array, ""]:
            left, count = carry
            return ~_is_within(LEFT, left, self.vector) & (count < CORRECTIONS)

        left, _ = lax.while_loop(goes_on, correct, (self.vector, jnp.asarray(0)))
        return _is_within(LEFT, left, self.vector)


def _is_within(part: float, x: Flat, vector: Flat) -> Bool[Array, ""]:
    return jnp.all(jnp.abs(x) <= part * jnp.abs(vector))


def _pattern(n: int) -> Float[np.ndarray, " n"]:
    """Numbers between ½ and 3/2 in size, of both signs, of which no sum is round."""
    random = np.random.default_rng(n)
    return (0.5 + random.random(n)) * random.choice([-1.0, 1.0], n)
