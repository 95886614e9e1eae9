"""What the steps of a solve depend on, once its state is encoded, for derivatives by all of it."""

from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..solvers import economical
from .between_steps import has_flow, held
from .diffrax_call import Decode, View
from .event_adjoint import conditions_of
from .event_functions import known_to_conditions
from .followed_steps import Stop
from .problem import Problem


if TYPE_CHECKING:
    from .program import Solve


class StepInputs(NamedTuple):
    """What a solve depends on, once the state is encoded."""

    formulation: Any
    solver: Any
    part: Any
    t0: Any
    t1: Any
    dt0: Any
    y: Any
    ode: Any
    view: Any
    # Of events whose times are looked for; that of others is the end of a step.
    conditions: Any

    @classmethod
    def of(cls, solve: "Solve", problem: Problem, stop: Stop | None) -> "StepInputs":
        """`stop`: where the solution ended, where it has events."""
        y, ode = solve.encoded(problem)
        part, t0, t1 = solve.saveat.subs, problem.t0, problem.t1
        solver, flow, still = economical(solve.solver, solve.between()), solve.flow(), solve.is_still(y)
        # Where there is no step, what is saved moves with its times as the equations say, else as the steps do, if these are not still.
        moves = t0 if still else jnp.where(t0 == t1, t0, jax.lax.stop_gradient(t0))
        y = held(y, moves, flow, ode) if has_flow(solve.formulation, y) else y
        decode, conditions = Decode(flow, solve.solver, still), None
        if stop is not None:
            assert isinstance(solve.event, diffrax.Event)
            direction, given = jnp.where(t1 < t0, -1, 1), known_to_conditions(solve, problem)
            if solve.event.root_finder is not None:
                conditions = conditions_of(solve.event, decode, problem.args, direction, given)
            t1 = jnp.where(stop.event >= 0, stop.time, t1)
        view = View(part.fn, decode, problem.args)
        return cls(solve.formulation, solver, part, t0, t1, problem.dt0, y, ode, view, conditions)

    def moving_apart(self, still: PyTree[Array]) -> tuple["StepInputs", "StepInputs"]:
        """What has cotangents and the rest, where these arrays are `still`: what is none of them, and in any case the state."""
        known = set(map(id, jax.tree.leaves(still)))
        moves = lambda x: eqx.is_inexact_array(x) and id(x) not in known
        flags = (
            jax.tree.map(eqx.is_inexact_array if name == "y" else moves, part) for name, part in self._asdict().items()
        )
        return eqx.partition(self, StepInputs(*flags))
