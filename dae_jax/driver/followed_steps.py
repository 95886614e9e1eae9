"""Steps that are written down, and taken again.

A derivative is a program of its own, which rounds in another way than the solve; where tolerances are tight, the two take steps of other
sizes and, after hundreds of steps, not as many. Where what is saved belongs to steps (dense output, `SaveAt(steps=True)`), the derivative
of the k-th step must be that of the step that the solution has there.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Int8, PyTree

from .._compat import nextafter
from ..equations.manifold_ode import Equations
from ..types import BoolScalar, IntScalar, Scalar, Y
from .between_steps import change_of_jump, jump_times
from .observed_steps import AbstractStepsOf, Step


class Ends(NamedTuple):
    """How many steps were accepted, and the times at their ends, that of the start first; then infinity."""

    count: IntScalar
    times: Float[Array, " steps"]


class RecordedEnds(eqx.Module):
    """The ends of steps, written down; `most` of them."""

    most: int = eqx.field(static=True)

    def begin(self, t0: Any, y0: Y, args: Equations) -> Ends:
        """Before the first step."""
        return Ends(jnp.asarray(0), jnp.full(self.most + 1, jnp.inf, t0.dtype).at[0].set(t0))

    def __call__(self, step: Step, before: Ends) -> Ends:
        # In place: what is rejected is written over, or taken back at the end.
        end = lax.stop_gradient(step.t1)
        times = lax.dynamic_update_index_in_dim(before.times, end, before.count + 1, 0)
        return Ends(before.count + step.kept, times)


class Stop(NamedTuple):
    """The time at which a solve with events ended, and the number of the event that ended it, −1 for none."""

    time: Float[Array, ""] | Int[Array, ""]
    event: Int[Array, ""]


class Steps(NamedTuple):
    """Steps to take: the times at their ends, that of the start first, then infinity; their formulas, where a solver has several; and
    where the solution stopped, where it has events.
    """

    times: Float[Array, " ends"] | Int[Array, " ends"]
    formulas: Int8[Array, " steps"] | None
    stop: Stop | None = None


def taken(ends: Ends, formulas: Int8[Array, " steps"] | None) -> Steps:
    """The steps that were accepted."""
    return Steps(lax.stop_gradient(jnp.where(jnp.arange(ends.times.size) <= ends.count, ends.times, jnp.inf)), formulas)


def as_bits(steps: Steps) -> Steps:
    """The times as integers, which have no derivative."""
    return _converted(steps, jnp.int64 if steps.times.dtype == jnp.float64 else jnp.int32)


def of_bits(steps: Steps) -> Steps:
    """The times as numbers again."""
    return _converted(steps, jnp.float64 if steps.times.dtype == jnp.int64 else jnp.float32)


def _converted(steps: Steps, kind: Any) -> Steps:
    converted = lambda times: lax.bitcast_convert_type(times, kind)
    stop = None if steps.stop is None else steps.stop._replace(time=converted(steps.stop.time))
    return steps._replace(times=converted(steps.times), stop=stop)


def reach(steps: Steps) -> BoolScalar:
    """Whether they lead to the end: else their times are NaN."""
    return ~jnp.isnan(steps.times[0])


def if_reached(tree: PyTree, steps: Steps | None, taken: BoolScalar) -> Any:
    """The numbers of a derivative, or NaN where its steps do not lead to the end or were not `taken`: one that failed in this program
    alone has no derivative, and what there would be is that of the steps before or after it.
    """
    if steps is None:
        return tree
    factor = jnp.where(reach(steps) & taken, 1.0, jnp.nan)
    return jax.tree.map(lambda x: x * factor.astype(x.dtype) if eqx.is_inexact_array(x) else x, tree)


class _Followed(NamedTuple):
    steps: Any
    count: IntScalar
    end: Scalar


def at_steps(controller: diffrax.AbstractStepSizeController, times: Float[Array, " steps"]) -> Any:
    """The controller with its steps' ends at these times."""
    followed: Any = FollowedSteps
    return followed(controller, times)


class FollowedSteps(AbstractStepsOf):
    """Steps with their ends at `times`, all accepted. Like those of another controller they are moved by the start and by jumps that are
    announced, and the last one ends at t1.
    """

    steps: Any
    times: Float[Array, " steps"]

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, _Followed]:
        _, state = self.steps.init(terms, t0, t1, y0, dt0, args, func, error_order)
        end = lax.stop_gradient(t1)
        return self._after(jnp.asarray(0), t0, end), _Followed(state, jnp.asarray(0), end)

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: _Followed,
    ) -> Any:
        state, count, end = controller_state
        # With an error of 0 the controller accepts the step, too, and sees where it made a jump.
        none = jax.tree.map(jnp.zeros_like, y_error)
        _, next_t0, _, made_jump, state, _ = self.steps.adapt_step_size(
            t0, t1, y0, y1_candidate, args, none, error_order, state
        )
        count = count + 1
        # A solve that failed goes no further.
        goes_on = (t1 >= end) | jnp.isfinite(self.times[count + 1])
        failed: Any = diffrax.RESULTS.dt_min_reached
        result = diffrax.RESULTS.where(goes_on, diffrax.RESULTS.successful, failed)
        return (
            jnp.asarray(True),
            next_t0,
            self._after(count, next_t0, end),
            made_jump,
            _Followed(state, count, end),
            result,
        )

    def _after(self, count: Int[Array, ""], t: Scalar, end: Scalar) -> Any:
        """The end of the step that begins at t."""
        following, jumps = self.times[count + 1], jump_times(self.steps)
        change = t - lax.stop_gradient(t)
        if jumps is not None and jumps.size:
            at_jump = jnp.any(nextafter(following) == jumps)
            change = jnp.where(at_jump, change_of_jump(jumps, following), change)
        return jnp.where(following >= end, jnp.inf, following + change)
