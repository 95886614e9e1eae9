"""Steps that are short enough for the derivative of a solve, too.

About an equilibrium, or a steady motion, the solution moves so little that its error allows any step; what a change of the start or of a
parameter grows into is lost in such steps. A derivative is found by steps whose error is the larger one of the solution's and the
derivative's own, relative to its size.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ..compiler import equations
from ..equations.consistent_change import consistent_change
from ..solvers import felt
from ..systems import is_mechanism
from ..types import Scalar, State, Time, Y
from .observed_steps import AbstractStepsOf
from .problem import Problem


# In parts of the solve, steps in which round-off of a derivative, over the step, is no reason for smaller ones.
SMALL = 1e-6


class OneDirection(diffrax.ForwardMode):
    """Forward derivatives along one direction, by steps that are short enough for it: those of the solution are the same."""


def some_change(problem: Problem, consistent: bool) -> State:
    """A change of all of a start, by no pattern, which stays `consistent` where this is asked for; 0 where no such is found, as with a
    resistor of 0 Ω: then steps are those of the solution.
    """
    system, t0, y0, args = problem.start
    numbers, tree = ravel_pytree(y0)
    change = tree((1 + jnp.abs(numbers)) * jnp.cos(1 + jnp.arange(numbers.size, dtype=numbers.dtype) ** 2))
    if not consistent:
        return change
    # In any metric, where a mass may be 0.
    metric: Any = dataclasses.replace(system, mass=None) if is_mechanism(system) else system
    change = consistent_change(metric, t0, y0, change, args)
    found = jnp.all(jnp.isfinite(ravel_pytree(change)[0]))
    return jax.tree.map(lambda x: jnp.where(found, x, 0), change)


def by_felt_steps(solved: Callable[[State], Any], y0: State, change: State) -> Any:
    """What a solve with `felt_steps` gives for a start, by steps that are short enough for what a change of it grows into. Where a
    function of the user has a derivative in reverse only, a rule of its own, they are those of the solution.
    """
    if any(eqn.primitive.name.startswith("custom_vjp") for eqn in equations(jax.make_jaxpr(solved)(y0))):
        return solved(y0)
    return jax.jvp(solved, (y0,), (change,))[0]


def felt_steps(controller: diffrax.AbstractAdaptiveStepSizeController, smallest: Scalar) -> Any:
    """The steps of a controller with tolerances, which gets the `felt` error of steps that are not smaller."""
    steps: Any = FeltSteps
    return steps(controller, smallest)


class FeltSteps(AbstractStepsOf):
    """Those of another controller with tolerances, which gets the `felt` error."""

    steps: Any
    smallest: Scalar

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
        error = None if y_error is None else felt(y_error, y0, y1_candidate, t1 - t0 >= self.smallest)
        return self.steps.adapt_step_size(t0, t1, y0, y1_candidate, args, error, error_order, controller_state)
