"""Steps within which the conditions of events cross zero more than once.

An event is found by the signs of its condition at the two ends of a step: of a condition that crosses zero and comes back there is
nothing to see there, and of two events within a step the first may be taken for the second. Such a step is tried again, shorter.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..equations.manifold_ode import constant
from ..formulations import AbstractFormulation
from ..solvers.wrapping import AbstractWrapper
from ..types import Args, BoolLike, Scalar, Time, Y


# So many points of a step are looked at between its ends.
POINTS = 7


class OnStates(eqx.Module):
    """A condition of the user's, on points of the solver's.

    - `direction`: 1 or −1, as the solve goes; diffrax's own time runs forwards.
    - `up`: in which direction it crosses, if in one only.
    """

    condition: Any
    decode: Any
    args: Args
    direction: Scalar
    up: bool | None = eqx.field(static=True)
    given: dict[str, Any]

    def __call__(self, t: Time, y: Y, args: Any, **kwargs: object) -> Any:
        t = self.direction * t
        value = jnp.asarray(self.condition(t, self.decode(t, y, args), self.args, **self.given))
        # diffrax puts it beside a number of the widest kind.
        value = value.astype(float) if jnp.issubdtype(value.dtype, jnp.floating) else value
        # NaN crosses in no direction: it ends the solve here, which then says so.
        return value if self.up is None else jnp.where(jnp.isnan(value), 1 if self.up else -1, value)


class OneCrossing(AbstractWrapper):
    """`solver`, with an infinite error of steps within which `conditions` cross zero more than once, or once where one of the `flags` is
    true at the end, which is an event there; down to steps of the length `shortest`, where events are at one time. A controller without
    tolerances cannot try again: it sees the error.
    """

    solver: diffrax.AbstractSolver
    conditions: list[Any]
    flags: list[Any]
    shortest: Scalar

    @classmethod
    def of(
        cls,
        solver: diffrax.AbstractSolver,
        conditions: list[Any],
        flags: list[Any],
        formulation: AbstractFormulation,
        t0: Time,
        t1: Time,
    ) -> "OneCrossing":
        """For signs, points between steps need not be on the constraints."""
        shortest = jnp.finfo(jnp.result_type(t0)).eps ** 0.5 * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        decode = lambda conditions: [eqx.tree_at(lambda c: c.decode, c, formulation.decode) for c in conditions]
        return cls(solver, decode(conditions), flags, shortest)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Any,
        made_jump: BoolLike,
    ) -> Any:
        y1, error, dense_info, solver_state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        if error is not None:
            self, start, end, dense, equations = constant((self, (t0, y0), (t1, y1), dense_info, args))
            path = self.solver.interpolation_cls(t0=start[0], t1=end[0], **dense)
            times = start[0] + (end[0] - start[0]) * jnp.arange(1, POINTS + 1) / (POINTS + 1)
            at = lambda t, y: jnp.stack([c(t, y, equations) for c in self.conditions])
            between = lax.map(lambda t: at(t, path.evaluate(t)), times)
            values = jnp.concatenate([at(*start)[None], between, at(*end)[None]])
            crossings = jnp.sum(values[:-1] * values[1:] < 0) + 2 * jnp.sum(_turns(values))
            flagged = jnp.any(jnp.asarray([c(*end, equations) for c in self.flags], bool))
            several = crossings + flagged > 1
            again = several & (end[0] - start[0] > self.shortest)
            error = jax.tree.map(lambda e: jnp.where(again, jnp.inf, e), error)
        return y1, error, dense_info, solver_state, result


def _turns(values: Float[Array, "points conditions"]) -> Bool[Array, "inner conditions"]:
    """Where the parabola through three values of one sign has its vertex between them, on the other side of zero."""
    before, at, after = values[:-2], values[1:-1], values[2:]
    slope, bend = (after - before) / 2, after - 2 * at + before
    vertex = at - slope**2 / jnp.where(bend == 0, 1, 2 * bend)
    return (before * at > 0) & (at * after > 0) & (jnp.abs(slope) <= jnp.abs(bend)) & (vertex * at < 0)
