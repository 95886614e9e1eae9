"""Steps that pass a configuration in which the constraints depend on each other, such as a dead centre, or leap over one, and steps
to states, or past states, at which the equations do not determine all unknowns.

They are not tried again with a smaller step: what really passes such a point, a parallelogram say, can only leap.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..equations.manifold_ode import Equations
from ..equations.mechanical import MechanicalODE
from ..equations.regularity import mass_is_regular, passes_singularity
from ..equations.structural_ode import ORIENTED, StructuralODE
from ..systems import is_mechanism
from ..types import BoolLike, BoolScalar, Time, Y
from .followed_steps import AbstractStepsOf
from .problem import Problem


# Relatively, the values of one determinant in a step in which its matrix jumps.
ALIKE = 0.1


class Seen(NamedTuple):
    """Whether a step, or one before it, has `passed` such a configuration or ends at one, where all is not `determined`; `mark`: what
    the next step is compared with.
    """

    passed: BoolLike
    determined: BoolLike
    mark: Any


class Passage(eqx.Module):
    """Whether a step from (t₀, y₀) to (t₁, y₁) passes a configuration in which the constraints depend on each other; and, of a method
    that `drifts`, whether the way back to the constraints may pass one. Of a method that does without M⁻¹, also whether `masses` that
    depend on the state have ceased to be positive.
    """

    ode: MechanicalODE
    decode: Callable[..., Any]
    drifts: bool = eqx.field(static=True)
    masses: bool = eqx.field(static=True)

    def begin(self, t: Time, y: Y, equations: Equations) -> Seen:
        """Before the first step."""
        return Seen(jnp.asarray(False), True, None)

    def __call__(self, t0: Time, y0: Y, t1: Time, y1: Y, equations: Equations, before: Seen) -> Seen:
        at = lambda t, y: self.ode.encode(self.decode(t, y, equations))
        start, end = at(t0, y0), at(t1, y1)
        passed = passes_singularity(self.ode, t0, start, t1, end, self.drifts)
        passed = passed | ~mass_is_regular(self.ode, end[0], False) if self.masses else passed
        return Seen(before.passed | passed, True, None)


class Undetermined(eqx.Module):
    """Whether a step of an explicit method ends where the equations do not determine all highest derivatives, or passes such a point:
    a determinant has another sign, and another value half-way. (Where the matrix jumps, with a switch, it has the value of one end.)
    """

    def begin(self, t: Time, y: Y, equations: Equations) -> Seen:
        """Before the first step, whose start is yet to be looked at."""
        assert isinstance(equations, StructuralODE)
        unknown = jnp.full((2, len(equations.oriented)), jnp.nan, jnp.result_type(t))
        return Seen(jnp.asarray(False), jnp.asarray(True), unknown)

    def __call__(self, t0: Time, y0: Y, t1: Time, y1: Y, equations: Equations, before: Seen) -> Seen:
        assert isinstance(equations, StructuralODE)

        def goes_on(carry: Any) -> BoolScalar:
            k, _, (start, end, _) = carry
            return (k < 2) | (k == 2) & jnp.any(end[0] * start[0] < 0)

        # At the start if that is not known yet, at the end, half-way if need be: in a loop, so that it is compiled once.
        def look(carry: Any) -> Any:
            k, _, found = carry
            at = lambda a, b: jnp.where(k == 0, a, jnp.where(k == 1, b, (a + b) / 2))
            determined, here = equations.determines_highest(at(t0, t1), jax.tree.map(at, y0, y1))
            return (
                k + 1,
                jnp.where(k == 1, determined, carry[1]),
                jnp.where(jnp.arange(3)[:, None, None] == k, here, found),
            )

        first = jnp.where(jnp.any(jnp.isnan(before.mark[0])), 0, 1)
        marks = jnp.stack([before.mark] * 3)
        _, determined, (start, end, half_way) = lax.while_loop(goes_on, look, (first, jnp.asarray(True), marks))
        jumps = (jnp.abs(half_way[1] - start[1]) < ALIKE) | (jnp.abs(half_way[1] - end[1]) < ALIKE)
        passed = before.passed | jnp.any((end[0] * start[0] < 0) & ~jumps)
        return Seen(passed, before.determined & determined, jnp.where(end[0] == 0, start, end))


def passages(
    problem: Problem, ode: Equations, decode: Callable[..., Any], drifts: bool, inverts_mass: bool
) -> Passage | Undetermined | None:
    """What sees them in the solution of a problem, by the equations that are integrated: in that of a mechanism with few
    constraints, or where the matrix of highest derivatives is not constant.
    """
    if isinstance(ode, StructuralODE):
        return Undetermined() if ode.varying else None
    system, t, state, args = problem.start
    if not is_mechanism(system):
        return None
    ode = MechanicalODE.of(system, t, state, args, problem.rank)
    masses = callable(system.mass) and not inverts_mass
    return Passage(ode, decode, drifts, masses) if 0 < ode.holonomic + ode.nonholonomic <= ORIENTED else None


def watched(controller: diffrax.AbstractStepSizeController, passage: Passage | Undetermined) -> "_AbstractWatchedSteps":
    """The controller with an eye on passages."""
    adapts = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    watched_steps: Any = WatchedAdaptiveSteps if adapts else WatchedSteps
    return watched_steps(controller, passage)


class _Watched(NamedTuple):
    """The controller's state, and what was seen of the steps."""

    steps: Any
    seen: Seen


class _AbstractWatchedSteps(diffrax.AbstractStepSizeController):
    """The steps of another controller."""

    steps: eqx.AbstractVar[Any]
    passage: eqx.AbstractVar[Passage | Undetermined]
    direction: eqx.AbstractVar[Any]

    def wrap(self, direction: Any) -> Any:
        return type(self)(self.steps.wrap(direction), self.passage, direction)

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any
    ) -> tuple[Any, _Watched]:
        first, state = self.steps.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return first, _Watched(state, self.passage.begin(self.direction * t0, y0, args))

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: _Watched,
    ) -> Any:
        keep, *rest, state, result = self.steps.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state.steps
        )
        before = controller_state.seen
        after = self.passage(self.direction * t0, y0, self.direction * t1, y1_candidate, args, before)
        kept = jax.tree.map(lambda new, old: jnp.where(keep, new, old), after, before)
        return keep, *rest, _Watched(state, kept), result


class WatchedSteps(_AbstractWatchedSteps):
    """Steps of a controller without tolerances."""

    steps: Any
    passage: Passage | Undetermined
    direction: Any = 1


class WatchedAdaptiveSteps(_AbstractWatchedSteps, AbstractStepsOf):
    """Steps of a controller with tolerances."""

    steps: Any
    passage: Passage | Undetermined
    direction: Any = 1
