"""Steps that pass a configuration in which the constraints depend on each other, such as a dead centre, or leap over one, and steps
to states, or past states, at which the equations do not determine all unknowns.

They are not tried again with a smaller step: what really passes such a point, a parallelogram say, can only leap.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

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
from .observed_steps import Step
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

    def begin(self, t0: Time, y0: Y, args: Equations) -> Seen:
        """Before the first step."""
        return Seen(jnp.asarray(False), True, None)

    def __call__(self, step: Step, before: Seen) -> Seen:
        at = lambda t, y: self.ode.encode(self.decode(t, y, step.args))
        t0, t1 = step.direction * step.t0, step.direction * step.t1
        start, end = at(t0, step.y0), at(t1, step.y1)
        passed = passes_singularity(self.ode, t0, start, t1, end, self.drifts)
        passed = passed | ~mass_is_regular(self.ode, end[0], False) if self.masses else passed
        return _if_kept(step, Seen(before.passed | passed, True, None), before)


class Undetermined(eqx.Module):
    """Whether a step of an explicit method ends where the equations do not determine all highest derivatives, or passes such a point:
    a determinant has another sign, and another value half-way. (Where the matrix jumps, with a switch, it has the value of one end.)
    """

    def begin(self, t0: Time, y0: Y, args: Equations) -> Seen:
        """Before the first step, whose start is yet to be looked at."""
        assert isinstance(args, StructuralODE)
        unknown = jnp.full((2, len(args.oriented)), jnp.nan, jnp.result_type(t0))
        return Seen(jnp.asarray(False), jnp.asarray(True), unknown)

    def __call__(self, step: Step, before: Seen) -> Seen:
        equations, t0, t1 = step.args, step.direction * step.t0, step.direction * step.t1
        assert isinstance(equations, StructuralODE)

        def goes_on(carry: Any) -> BoolScalar:
            k, _, (start, end, _) = carry
            return (k < 2) | (k == 2) & jnp.any(end[0] * start[0] < 0)

        # At the start if that is not known yet, at the end, half-way if need be: in a loop, so that it is compiled once.
        def look(carry: Any) -> Any:
            k, _, found = carry
            at = lambda a, b: jnp.where(k == 0, a, jnp.where(k == 1, b, (a + b) / 2))
            determined, here = equations.determines_highest(at(t0, t1), jax.tree.map(at, step.y0, step.y1))
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
        after = Seen(passed, before.determined & determined, jnp.where(end[0] == 0, start, end))
        return _if_kept(step, after, before)


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


def _if_kept(step: Step, after: Seen, before: Seen) -> Seen:
    return jax.tree.map(lambda new, old: jnp.where(step.kept, new, old), after, before)
