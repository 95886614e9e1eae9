"""The reverse derivative of a solve by its trajectory, as a function of the solve's arrays."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ..compiler import Moving, PullBack, inexact
from ..compiler.types import Arrays
from ..solution import Split
from ..solvers import replays
from ..types import Scalar
from ..validate.captured import settled
from .diffrax_call import took_steps
from .event_adjoint import end_of, up_to
from .followed_steps import Stop, as_bits, if_reached, of_bits
from .problem import Program
from .step_inputs import StepInputs
from .trajectory_adjoint import cotangents, recorded, with_times


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
                found, fixed[:] = StepInputs.of(solve, problem, stop).moving_apart(others)
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
