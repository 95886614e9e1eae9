"""The errors of fixed steps added up, where the method estimates them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from ..equations.manifold_ode import Equations
from ..types import Scalar, Time, Y
from .observed_steps import Step


class Errors(NamedTuple):
    """The largest that each part of the state has been, and the sum of the errors."""

    sizes: PyTree[Scalar]
    total: Scalar


class SummedErrors(eqx.Module):
    """The sum of the errors of steps: each the largest of any part of the state, relative to the largest that this part has been."""

    def begin(self, t0: Time, y0: Y, args: Equations) -> Errors:
        """Before the first step."""
        return Errors(_sizes(y0), jnp.zeros_like(t0))

    def __call__(self, step: Step, before: Errors) -> Errors:
        if step.error is None:
            return before
        y1, error = lax.stop_gradient((step.y1, step.error))
        sizes = jax.tree.map(jnp.maximum, before.sizes, _sizes(y1))
        parts = jax.tree.map(lambda e, size: e / jnp.where(size > 0, size, 1), _sizes(error), sizes)
        return Errors(sizes, before.total + jnp.max(jnp.stack(jax.tree.leaves(parts))))


def _sizes(y: PyTree) -> PyTree[Scalar]:
    return jax.tree.map(lambda x: lax.stop_gradient(jnp.max(jnp.abs(x), initial=0)), y)
