"""Steps that are short enough for the derivative of a solve, too.

About an equilibrium, or a steady motion, the solution moves so little that its error allows any step; what a change of the start or of a
parameter grows into is lost in such steps. A derivative is found by steps whose error is the larger one of the solution's and the
derivative's own, relative to its size.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from ..types import State, Time, Y
from .observed_steps import AbstractStepsOf


@jax.custom_jvp
def felt(error: Y, y0: Y, y1: Y) -> Y:
    """The error of a step from y₀ to y₁. Under forward derivatives it is, where that is more, δerror · (1 + |y|) / |δy|."""
    return error


@felt.defjvp
def _(primals: tuple[Y, Y, Y], tangents: tuple[Y, Y, Y]) -> Any:
    error, y0, y1 = primals
    largest = lambda *trees: jnp.max(jnp.stack([jnp.max(jnp.abs(x), initial=0.0) for x in jax.tree.leaves(trees)]))
    size = largest(tangents[1], tangents[2])
    relative = 1 / jnp.where(size > 0, size, 1)

    def larger(error: Any, change: Any, before: Any, after: Any) -> Any:
        of_change = jnp.abs(change) * relative * (1 + jnp.maximum(jnp.abs(before), jnp.abs(after)))
        return lax.stop_gradient(jnp.where(of_change > jnp.abs(error), of_change, error))

    found = jax.tree.map(larger, error, tangents[0], y0, y1)
    return found, jax.tree.map(jnp.zeros_like, found)


def some_change(y: State) -> Any:
    """A direction in which all of a state moves, by no pattern."""
    numbers, tree = ravel_pytree(y)
    return tree((1 + jnp.abs(numbers)) * jnp.cos(1 + jnp.arange(numbers.size, dtype=numbers.dtype) ** 2))


def felt_steps(controller: diffrax.AbstractAdaptiveStepSizeController) -> Any:
    """The steps of a controller with tolerances, which gets the `felt` error."""
    steps: Any = FeltSteps
    return steps(controller)


class FeltSteps(AbstractStepsOf):
    """Those of another controller with tolerances, which gets the `felt` error."""

    steps: Any

    def wrap(self, direction: Any) -> Any:
        return type(self)(self.steps.wrap(direction))  # pyright: ignore[reportCallIssue]

    def init(
        self, terms: Any, t0: Time, t1: Time, y0: Y, dt0: Any, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, Any]:
        return self.steps.init(terms, t0, t1, y0, dt0, args, func, error_order)

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
        error = None if y_error is None else felt(y_error, y0, y1_candidate)
        return self.steps.adapt_step_size(t0, t1, y0, y1_candidate, args, error, error_order, controller_state)
