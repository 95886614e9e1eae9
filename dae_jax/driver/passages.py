"""Steps that pass a configuration in which the constraints depend on each other, such as a dead centre, or leap over one, and steps
to states at which the equations do not determine all unknowns.

They are not tried again with a smaller step: what really passes such a point, a parallelogram say, can only leap.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp

from ..equations.manifold_ode import Equations
from ..equations.mechanical import MechanicalODE
from ..equations.regularity import mass_is_regular, passes_singularity
from ..equations.structural_ode import StructuralODE
from ..systems import is_mechanism
from ..types import BoolScalar, Time, Y
from .problem import Problem


# With more constraints a determinant takes longer than a step.
MOST = 32


class Passage(eqx.Module):
    """Whether a step from (t₀, y₀) to (t₁, y₁) passes a configuration in which the constraints depend on each other; and, of a method
    that `drifts`, whether the way back to the constraints may pass one. Of a method that does without M⁻¹, also whether `masses` that
    depend on the state have ceased to be positive.
    """

    ode: MechanicalODE
    decode: Callable[..., Any]
    drifts: bool = eqx.field(static=True)
    masses: bool = eqx.field(static=True)

    def __call__(self, t0: Time, y0: Y, t1: Time, y1: Y, equations: Equations) -> BoolScalar:
        at = lambda t, y: self.ode.encode(self.decode(t, y, equations))
        before, after = at(t0, y0), at(t1, y1)
        passed = passes_singularity(self.ode, t0, before, t1, after, self.drifts)
        return passed | ~mass_is_regular(self.ode, after[0], False) if self.masses else passed


class Undetermined(eqx.Module):
    """Whether a step of an explicit method ends where the equations do not determine all highest derivatives."""

    def __call__(self, t0: Time, y0: Y, t1: Time, y1: Y, equations: Equations) -> BoolScalar:
        assert isinstance(equations, StructuralODE)
        return ~equations.determines_highest(t1, y1)


def passages(
    problem: Problem, ode: Equations, decode: Callable[..., Any], drifts: bool, inverts_mass: bool
) -> Passage | Undetermined | None:
    """What sees them in the solution of a problem, by the equations that are integrated: in that of a mechanism with few
    constraints, or where the matrix of highest derivatives is not constant.
    """
    if isinstance(ode, StructuralODE):
        return Undetermined() if ode.varies else None
    system, t, state, args = problem.start
    if not is_mechanism(system):
        return None
    ode = MechanicalODE.of(system, t, state, args, problem.rank)
    masses = callable(system.mass) and not inverts_mass
    return Passage(ode, decode, drifts, masses) if 0 < ode.holonomic + ode.nonholonomic <= MOST else None


def watched(controller: diffrax.AbstractStepSizeController, passage: Passage | Undetermined) -> "_AbstractWatchedSteps":
    """The controller with an eye on passages."""
    adapts = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    watched_steps: Any = WatchedAdaptiveSteps if adapts else WatchedSteps
    return watched_steps(controller, passage)


class _Watched(NamedTuple):
    """The controller's state, and whether a step has passed such a configuration."""

    steps: Any
    passed: BoolScalar


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
        return first, _Watched(state, jnp.asarray(False))

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
        passes = self.passage(self.direction * t0, y0, self.direction * t1, y1_candidate, args)
        return keep, *rest, _Watched(state, controller_state.passed | (keep & passes)), result


class WatchedSteps(_AbstractWatchedSteps):
    """Steps of a controller without tolerances."""

    steps: Any
    passage: Passage | Undetermined
    direction: Any = 1


class WatchedAdaptiveSteps(_AbstractWatchedSteps, diffrax.AbstractAdaptiveStepSizeController):
    """Steps of a controller with tolerances."""

    steps: Any
    passage: Passage | Undetermined
    direction: Any = 1

    @property
    def rtol(self) -> Any:
        return self.steps.rtol

    @property
    def atol(self) -> Any:
        return self.steps.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.steps.norm
