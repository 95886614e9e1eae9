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

from ..equations.index1_form import Index1Form
from ..equations.leading import LeadingMatrix
from ..equations.linearised import LinearisedResidual
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
    """Whether a step of an explicit method ends where the equations do not determine all highest derivatives, or any step passes such
    a point: a determinant has another sign, and another value half-way. (Where the matrix jumps, with a switch, it has the value of
    one end.) `leading`: of the equations that a method for residuals solves as they are written.
    """

    leading: LeadingMatrix | None = eqx.field(static=True, default=None)

    def begin(self, t0: Time, y0: Y, args: Equations) -> Seen:
        """Before the first step, whose start is yet to be looked at."""
        dtype = jnp.result_type(t0)
        if self.leading is not None:
            assert isinstance(args, LinearisedResidual)
            blocks, slope = self.leading.blocks, _Slope(args.start, jnp.zeros((), dtype))
        else:
            blocks, slope = _underlying(args).oriented, None
        return Seen(jnp.asarray(False), jnp.asarray(True), (jnp.full((2, len(blocks)), jnp.nan, dtype), slope))

    def _look(self, equations: Any, t: Time, y: Y, ydot: Any) -> tuple[BoolLike, Any]:
        """Whether all is determined at a point, and what of the determinants is compared."""
        if self.leading is not None:
            return True, self.leading.determinants(equations.form, t, y, ydot)
        ode = _underlying(equations)
        determined, found = ode.determines_highest(t, y[: ode.orders.size])
        # A method for residuals looks at the matrix of its own unknowns.
        return determined if ode is equations else True, found

    def __call__(self, step: Step, before: Seen) -> Seen:
        t0, t1 = step.direction * step.t0, step.direction * step.t1
        marked, slope = before.mark
        ydot = (0, 0) if slope is None else slope.at_ends(t1 - t0, step.y1 - step.y0)

        def goes_on(carry: Any) -> BoolScalar:
            k, _, (start, end, _) = carry
            return (k < 2) | (k == 2) & jnp.any(end[0] * start[0] < 0)

        # At the start if that is not known yet, at the end, half-way if need be: in a loop, so that it is compiled once.
        def look(carry: Any) -> Any:
            k, _, found = carry
            at = lambda a, b: jnp.where(k == 0, a, jnp.where(k == 1, b, (a + b) / 2))
            point = at(t0, t1), jax.tree.map(at, step.y0, step.y1), at(*ydot)
            determined, here = self._look(step.args, *point)
            return (
                k + 1,
                jnp.where(k == 1, determined, carry[1]),
                jnp.where(jnp.arange(3)[:, None, None] == k, here, found),
            )

        first = jnp.where(jnp.any(jnp.isnan(marked[0])), 0, 1)
        _, determined, (start, end, half_way) = lax.while_loop(
            goes_on, look, (first, jnp.asarray(True), jnp.stack([marked] * 3))
        )
        same = lambda a, b: (a[0] == b[0]) & (jnp.abs(a[1] - b[1]) < ALIKE)
        jumps = same(half_way, start) | same(half_way, end)
        passed = before.passed | jnp.any((end[0] * start[0] < 0) & ~jumps)
        slope = None if slope is None else slope.after(t1 - t0, step.y1 - step.y0)
        mark = jnp.where(end[0] == 0, start, end), slope
        return _if_kept(step, Seen(passed, before.determined & determined, mark), before)


class _Slope(NamedTuple):
    """That of the last step, and its size; before the first one ẏ, and 0."""

    ydot: Any
    size: Any

    def at_ends(self, h: Any, change: Any) -> Any:
        """ẏ at the ends of the next step, of that size, by the parabola of both."""
        bend = (change / h - self.ydot) * (h / (h + self.size))
        return change / h - bend, change / h + bend

    def after(self, h: Any, change: Any) -> "_Slope":
        return _Slope(change / h, h)


def _underlying(equations: Any) -> StructuralODE:
    """The underlying ODE that is integrated, or that equations of index 1 are made of."""
    return equations if isinstance(equations, StructuralODE) else equations.form.ode


def passages(
    problem: Problem, ode: Equations, decode: Callable[..., Any], drifts: bool, inverts_mass: bool
) -> Passage | Undetermined | None:
    """What sees them in the solution of a problem, by the equations that are integrated: in that of a mechanism with few
    constraints, or where the matrix of highest derivatives is not constant.
    """
    system, t, state, args = problem.start
    if isinstance(ode, StructuralODE) or (isinstance(ode, LinearisedResidual) and isinstance(ode.form, Index1Form)):
        return Undetermined() if _underlying(ode).varying else None
    if not is_mechanism(system):
        assert isinstance(ode, LinearisedResidual)
        leading = LeadingMatrix.of(ode.form, jnp.result_type(t))
        return Undetermined(leading) if leading.blocks else None
    ode = MechanicalODE.of(system, t, state, args, problem.rank)
    masses = callable(system.mass) and not inverts_mass
    return Passage(ode, decode, drifts, masses) if 0 < ode.holonomic + ode.nonholonomic <= ORIENTED else None


def _if_kept(step: Step, after: Seen, before: Seen) -> Seen:
    return jax.tree.map(lambda new, old: jnp.where(step.kept, new, old), after, before)
