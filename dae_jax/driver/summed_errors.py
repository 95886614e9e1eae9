"""Fixed steps whose errors are added up, where the method estimates them."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from ..types import Scalar


class SummedErrors(diffrax.AbstractStepSizeController):
    """The steps of another controller, and the sum of their errors: each the largest of any part of the state, relative to the
    largest that this part has been. It is the last of the controller's state.
    """

    steps: diffrax.AbstractStepSizeController

    def wrap(self, direction: Any) -> "SummedErrors":
        return SummedErrors(self.steps.wrap(direction))

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, Any]:
        t1, state = self.steps.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return t1, (state, _sizes(y0), jnp.zeros_like(t0))

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> Any:
        state, sizes, total = controller_state
        *out, state, result = self.steps.adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, state)
        if y_error is not None:
            y1, error = lax.stop_gradient((y1_candidate, y_error))
            sizes = jax.tree.map(jnp.maximum, sizes, _sizes(y1))
            parts = jax.tree.map(lambda e, size: e / jnp.where(size > 0, size, 1), _sizes(error), sizes)
            total = total + jnp.max(jnp.stack(jax.tree.leaves(parts)))
        return *out, (state, sizes, total), result


def _sizes(y: PyTree) -> PyTree[Scalar]:
    return jax.tree.map(lambda x: lax.stop_gradient(jnp.max(jnp.abs(x), initial=0)), y)
