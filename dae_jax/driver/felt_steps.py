"""Steps that are short enough for the derivative of a solve, too.

About an equilibrium, or a steady motion, the solution moves so little that its error allows any step; what a change of the start or of a
parameter grows into is lost in such steps. A derivative is found by steps whose error is the larger one of the solution's and the
derivative's own, relative to its size.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import jaxpr_as_fun

from ..compiler import equations, without_checks
from ..solvers import felt
from ..types import BoolScalar, IntScalar, Scalar, Time, Y
from .followed_steps import Steps, as_bits, of_bits, reach
from .observed_steps import AbstractStepsOf


# In parts of the solve, steps in which round-off of a derivative, over the step, is no reason for smaller ones.
SMALL = 1e-6


class OneDirection(diffrax.ForwardMode):
    """Forward derivatives along one direction, by steps that are short enough for it: those of the solution are the same."""


def by_felt_steps(solved: Callable[[Any], tuple[Steps, BoolScalar]], given: Any, changes: Any) -> Steps:
    """The steps of a solve with `felt_steps`, short enough for what the first of `changes` grows into, or else the next: where the index
    of the equations is another one for a parameter beside the given one, as for a resistor of 0 Ω, a change of it allows none. NaN where
    none leads to the end. Where a function of the user has a derivative in reverse only, a rule of its own, they are those of the
    solution.
    """
    jaxpr, out = jax.make_jaxpr(solved, return_shape=True)(given)
    shapes, tree = out[0], jax.tree.structure(out)
    traced = lambda given: jax.tree.unflatten(tree, jaxpr_as_fun(jaxpr)(*jax.tree.leaves(given)))
    one_way = any(eqn.primitive.name.startswith("custom_vjp") for eqn in equations(jaxpr))

    # What is refused the solution refuses, too; in a loop it could not become part of a kernel.
    @without_checks
    def attempt(change: Any) -> tuple[Steps, BoolScalar]:
        return traced(given) if one_way else jax.jvp(traced, (given,), (change,))[0]

    def again(carry: tuple[IntScalar, Steps]) -> tuple[IntScalar, Steps]:
        k, _ = carry
        steps, ended = attempt(jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), changes))
        return k + 1, as_bits(steps._replace(times=jnp.where(ended, steps.times, jnp.nan)))

    most = len(jax.tree.leaves(changes)[0])
    none = as_bits(jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan).astype(x.dtype), shapes))
    return lax.while_loop(lambda carry: (carry[0] < most) & ~reach(of_bits(carry[1])), again, (jnp.asarray(0), none))[1]


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
        counts = t1 - t0 >= self.smallest
        error = None if y_error is None else felt(y_error, y0, y1_candidate, counts, self.rtol, self.atol)
        return self.steps.adapt_step_size(t0, t1, y0, y1_candidate, args, error, error_order, controller_state)
