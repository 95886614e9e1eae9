"""The reverse derivative of a solve by its trajectory, as a function of the solve's arrays."""

import dataclasses
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ..compiler import Moving, PullBack, inexact
from ..compiler.types import Arrays
from ..solution import Split
from ..solvers import economical, replays
from ..types import Scalar
from ..validate.captured import settled
from .between_steps import held
from .diffrax_call import Decode, View, took_steps
from .event_adjoint import conditions_of, end_of, up_to
from .event_functions import known_to_conditions
from .followed_steps import Stop, as_bits, if_reached, of_bits
from .problem import Problem, Program
from .trajectory_adjoint import StepInputs, cotangents, recorded, with_times


if TYPE_CHECKING:
    from .program import Solve


def by_trajectory(program: Program) -> PullBack:
    """The reverse derivative of the solve of a problem, both of which the `program` is made of."""

    def pull_back(inputs: tuple[Arrays], cotangent: Split, moving: Moving) -> list[Any]:
        with settled(program.leaves):
            arrays, *steps = inputs
            solve, problem = program.whole(arrays)
            stop, begun = None, problem
            if solve.event is not None:
                (known,) = steps
                forward, _ = solve.forwards().kernel(problem)
                end = end_of(forward, arrays, known)
                stop = Stop(end, known.stop.event)
                begun = dataclasses.replace(problem, t1=end)
                steps = [as_bits(up_to(known, jnp.where(problem.t1 < problem.t0, -end, end)))]
            recording = dataclasses.replace(
                solve.forwards(), saveat=recorded(replays(solve.solver)), event=None, recording=True
            )
            record, also_arrays = recording.kernel(begun)
            again = record(also_arrays, *steps).whole()
            _, _, ts, ys, interpolation, *_ = again
            # The flags of steps come after those of the arrays.
            numbers, others = eqx.partition(arrays, list(moving[: len(arrays)]))
            fixed: list[Any] = []

            def encoded(numbers: PyTree) -> tuple[Any, Scalar]:
                solve, problem = program.whole(eqx.combine(numbers, others))
                found, fixed[:] = _step_inputs(solve, problem, stop).moving_apart(others)
                return found, problem.t1

            (found, _), through_encoding = jax.vjp(encoded, numbers)
            of_t0, of_t1, of_ts, of_ys, _, of_stats, *_ = cotangent.numbers
            trajectory = ts, ys, None if interpolation is None else interpolation.path.infos
            fixed_steps = isinstance(solve.controller, diffrax.ConstantStepSize)
            of_inputs = cotangents(
                found, StepInputs(*fixed), fixed_steps, trajectory, (of_ts, of_ys), of_stats["end_time"], stop
            )
            (of_arrays,) = through_encoding((with_times(of_inputs, of_t0, None, None), of_t1))
            return inexact(if_reached(of_arrays, of_bits(*steps) if steps else None, took_steps(again)))

    return pull_back


def _step_inputs(solve: "Solve", problem: Problem, stop: Stop | None) -> StepInputs:
    y, ode = solve.encoded(problem)
    part, t0, t1 = solve.saveat.subs, problem.t0, problem.t1
    solver, flow, still = economical(solve.solver, solve.between()), solve.flow(), solve.is_still(y)
    # An interval without length has no derivatives by its times.
    start = jnp.where(t0 == t1, jax.lax.stop_gradient(t0), t0)
    y = held(y, start, flow, ode) if still else y
    decode, conditions = Decode(flow, solve.solver, still), None
    if stop is not None:
        direction, given = jnp.where(t1 < t0, -1, 1), known_to_conditions(solve, problem)
        conditions = conditions_of(solve.event, decode, problem.args, direction, given)
        t1 = jnp.where(stop.event >= 0, stop.time, t1)
    view = View(part.fn, decode, problem.args)
    return StepInputs(solve.formulation, solver, part, t0, t1, problem.dt0, y, ode, view, conditions)
