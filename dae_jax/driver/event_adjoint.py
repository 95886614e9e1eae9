"""The time of an event in the reverse derivative of a solve: where the trajectory ends, which follows from all else.

Along the solution c(t_e, y(t_e), p) = 0, so that dt_e = −(c_y dy + c_p dp) / ċ with ċ = c_t + c_y ẏ.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ..compiler.types import Arrays
from ..types import BoolScalar, IntScalar, Scalar, Time, Y
from .crossings import OnStates
from .followed_steps import Steps, Stop, as_bits, of_bits


# The last step of a derivative may end so much before an event, as a part of the interval, or by as much as it is long.
NEAR = 1e-3


def conditions_of(event: diffrax.Event, decode: Any, args: Any, direction: Scalar, given: dict[str, Any]) -> PyTree:
    """The conditions of an event, on points of the solver's."""
    on_states = lambda condition, up: OnStates(condition, decode, args, direction, up, given)
    return jax.tree.map(on_states, event.cond_fn, event.direction, is_leaf=lambda x: x is None or callable(x))


def stop_of(fields: tuple[Any, ...]) -> Stop:
    """Where the solve ended that has given these fields, and by which of its events."""
    event_mask, (end, _) = fields[7], fields[9]
    mask = jnp.stack(jax.tree.leaves(event_mask))
    return Stop(end, jnp.where(jnp.any(mask), jnp.argmax(mask), -1).astype(jnp.int32))


def stopped(steps: Steps, stop: Stop, backwards: BoolScalar) -> Steps:
    """Steps of a derivative up to where the solution has `stop`ped; NaN where they have ended long before, by another event."""
    numbers = of_bits(steps)
    times, last = numbers.times, jnp.sum(jnp.isfinite(numbers.times)) - 1
    end = jnp.where(backwards, -stop.time, stop.time)
    allowed = times[last] - times[jnp.maximum(last - 1, 0)] + NEAR * (end - times[0])
    lost = (stop.event >= 0) & (end - times[last] > allowed)
    return as_bits(numbers._replace(times=jnp.where(lost, jnp.nan, times), stop=stop))


def end_of(solved: Callable[[Arrays, Steps], Any], arrays: Arrays, steps: Steps) -> Scalar:
    """The time at which a solve has stopped; `solved` by these steps with forward derivatives, of which that time has its own."""

    @jax.custom_jvp
    def end(arrays: Arrays, steps: Steps) -> Any:  # noqa: ARG001
        return _stop(steps).time

    @end.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        arrays, steps = primals
        time = lambda arrays: solved(arrays, steps).whole()[5]["end_time"]
        return end(arrays, steps), jax.jvp(time, (arrays,), tangents[:1])[1]

    return end(arrays, steps)


def _stop(steps: Steps) -> Stop:
    stop = of_bits(steps).stop
    assert stop is not None
    return stop


def up_to(steps: Steps, end: Scalar) -> Steps:
    """Those that begin before this time of the integration, the last of them with its end there: by steps of a derivative an event is
    earlier or later than by those of the solution, as far as its error goes.
    """
    numbers = of_bits(steps)
    taken = jnp.arange(numbers.times.size) < jnp.sum(jnp.isfinite(numbers.times)) - 1
    kept = taken & (numbers.times < end)
    times = (
        jnp.where(kept, numbers.times, jnp.inf)
        .at[jnp.sum(kept)]
        .set(jnp.where(jnp.isnan(numbers.times[0]), jnp.nan, end))
    )
    return numbers._replace(times=times, stop=None)


def at_event(
    event: IntScalar,
    of_conditions: Callable[[PyTree, Time, Y], list[Any]],
    numbers: PyTree,
    t: Time,
    y: Y,
    of_t: Scalar,
) -> tuple[Any, Any]:
    """What the cotangent `of_t` of the time at which an event has ended a solve, at (t, y), is for its condition's numbers and for y;
    nothing where no event did, of which there are several. The time of a flag is the end of a step, which stays.
    """
    real: list[bool] = []

    def condition(numbers: PyTree, t: Time, y: Y) -> Any:
        values = list(map(jnp.asarray, of_conditions(numbers, t, y)))
        real[:] = [jnp.issubdtype(value.dtype, jnp.floating) for value in values]
        zero = jnp.zeros_like(of_t)
        return jnp.stack([value.astype(zero.dtype) if r else zero for value, r in zip(values, real, strict=True)])[
            event
        ]

    _, pull_back = jax.vjp(condition, numbers, t, y)
    of_numbers, rate, of_y = pull_back(jnp.ones_like(of_t))
    counts = (event >= 0) & jnp.array(real)[event] & (of_t != 0)
    factor = -of_t / jnp.where(counts, rate, 1)
    moved = functools.partial(jax.tree.map, lambda x: jnp.where(counts, factor.astype(x.dtype) * x, 0))
    return moved(of_numbers), moved(of_y)
