"""Steps that are short enough for the derivative of a solve, too.

About an equilibrium, or a steady motion, the solution moves so little that its error allows any step; what a change of the start or of a
parameter grows into is lost in such steps. A derivative is found by steps whose error is the larger one of the solution's and the
derivative's own, relative to its size.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..compiler import equations
from ..compiler.jaxprs.unchecked import without_checks
from ..equations.consistent_change import consistent_change
from ..solvers import felt
from ..systems import is_mechanism
from ..types import BoolScalar, IntScalar, Scalar, Time, Y
from .followed_steps import Steps, as_bits, of_bits, reach
from .observed_steps import AbstractStepsOf
from .problem import Problem


if TYPE_CHECKING:
    from .program import Solve


# In parts of the solve, steps in which round-off of a derivative, over the step, is no reason for smaller ones.
SMALL = 1e-6
# Parameters change by this part of them. What they lead to counts where changes of the start have died down, and does not hide these
# elsewhere: errors are relative to the largest of all that changes, a multiplier too.
PARAMETERS = 0.01


class OneDirection(diffrax.ForwardMode):
    """Forward derivatives along one direction, by steps that are short enough for it: those of the solution are the same."""


def changing(solve: "Solve", problem: Problem) -> tuple[Any, Any]:
    """What a derivative may be by, the inexact arrays in (formulation, system, args) and the start, and all else of these."""
    return eqx.partition(((solve.formulation, problem.system, problem.args), problem.y0), eqx.is_inexact_array)


def with_changes(solve: "Solve", problem: Problem, given: Any) -> tuple["Solve", Problem]:
    """The same with others of what is `changing`."""
    (formulation, system, args), y0 = given
    return (
        dataclasses.replace(solve, formulation=formulation),
        dataclasses.replace(problem, system=system, args=args, y0=y0),
    )


def some_changes(solve: "Solve", problem: Problem, consistent: bool) -> Any:
    """A change of all that is `changing`, by no pattern, and, where the start must stay `consistent` and parameters may change the index,
    one of the start alone. Nothing changes where no such is found: then steps are those of the solution.
    """
    (parameters, start), _ = changing(solve, problem)
    of_parameters = _by_no_pattern(parameters, lambda x: PARAMETERS * jnp.where(x == 0, 1, jnp.abs(x)))
    change = _by_no_pattern(start, lambda x: 1 + jnp.abs(x))
    if not consistent:
        return jax.tree.map(lambda x: x[None], (of_parameters, change))
    system, t0, y0, args = problem.start
    # In any metric, where a mass may be 0.
    without_mass = lambda x: eqx.tree_at(lambda x: x.mass, x, None, is_leaf=lambda x: x is None)
    metric = without_mass if is_mechanism(system) else lambda x: x

    @functools.partial(jax.vmap, axis_size=2)
    def changes(of_parameters: Any) -> Any:
        along = consistent_change(metric(system), t0, y0, change, args, (metric(of_parameters[1]), of_parameters[2]))
        found = jnp.all(jnp.isfinite(ravel_pytree(along)[0]))
        return jax.tree.map(lambda x: jnp.where(found, x, 0), (of_parameters, along))

    return changes(jax.tree.map(lambda x: jnp.stack([x, jnp.zeros_like(x)]), of_parameters))


def _by_no_pattern(tree: PyTree[Array], sizes: Callable[[Array], Array]) -> Any:
    numbers, unflatten = ravel_pytree(tree)
    # Parameters may be complex.
    return unflatten((sizes(numbers) * jnp.cos(1.0 + jnp.arange(numbers.size) ** 2)).astype(numbers.dtype))


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
