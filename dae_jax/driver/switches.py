"""Equations that switch with time, as `t % period < width` or a `clip` of the time do, and steps in which they do so more than once:
a pulse between the points at which a method evaluates them is stepped over, and leaves no trace in the estimate of the error.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from ..compiler.jaxprs.inline import Inlining
from ..compiler.jaxprs.walk import needed_for
from ..compiler.types import Atom
from ..equations.manifold_ode import Equations
from ..types import BoolScalar, Time, Y
from .observed_steps import Step
from .problem import Problem


# So many points of a step are looked at.
POINTS = 64
# In units of the relative rounding: shorter steps are not looked at.
RESOLVED = 1000
_COMPARISONS = frozenset({"lt", "le", "gt", "ge", "eq", "ne", "sign"})
# They choose among their operands; where it is this one, the result equals it.
_CHOICES = {"abs": 0, "clamp": 1, "max": 0, "min": 0}


class SteppedOver(eqx.Module):
    """Whether in a step, or one before it, `comparisons` of the time change their results more than once."""

    comparisons: Jaxpr = eqx.field(static=True)
    constants: list[Any]

    def begin(self, t0: Time, y0: Y, args: Equations) -> BoolScalar:
        """Before the first step."""
        return jnp.asarray(False)

    def __call__(self, step: Step, before: BoolScalar) -> BoolScalar:
        # Between them and not at the ends, which may be switchings themselves.
        places = (jnp.arange(POINTS, dtype=jnp.result_type(step.t0)) + 0.5) / POINTS
        at = lambda part: step.direction * (step.t0 + part * (step.t1 - step.t0))
        results = jax.vmap(lambda part: eval_jaxpr(self.comparisons, self.constants, at(part)))(places)
        changes = [jnp.any((x[1:] != x[:-1]).reshape(POINTS - 1, -1), axis=1) for x in results]
        often = jnp.sum(jnp.any(jnp.stack(changes), axis=0)) > 1
        # In steps of a few units of the last place, which find where a switching is, `==` may hold at one of the points.
        resolved = jnp.abs(step.t1 - step.t0) > RESOLVED * jnp.finfo(places.dtype).eps * jnp.abs(step.t1)
        return before | (step.kept & often & resolved)


def stepped_over(problem: Problem) -> SteppedOver | None:
    """What sees such steps in the solution of a problem; `None` where its equations do not switch with time alone."""
    system, t, state, args = problem.start
    calls = system.calls(t, state, args)
    of_time = lambda t, states: [c.function(t, *s, args) for c, s in zip(calls, states, strict=True)]
    flat = Inlining()(jax.make_jaxpr(of_time)(t, [c.values[1:-1] for c in calls]))
    every, found = _comparisons(flat)
    if not found:
        return None
    eqns, needed = needed_for(found, [eqn for eqn in every if not eqn.effects])
    constants = [(v, x) for v, x in zip(flat.jaxpr.constvars, flat.consts, strict=True) if v in needed]
    comparisons = flat.jaxpr.replace(
        constvars=[v for v, _ in constants], invars=flat.jaxpr.invars[:1], outvars=found, eqns=eqns
    )
    return SteppedOver(comparisons, [jnp.asarray(x) for _, x in constants])


def _comparisons(flat: ClosedJaxpr) -> tuple[list[JaxprEqn], list[Any]]:
    """The equations, and the results of comparisons among them that depend on the first argument, the time, and on no other."""
    time, *state = flat.jaxpr.invars
    timely, others = {time}, set(state)
    eqns, found = [], []
    for eqn in flat.jaxpr.eqns:
        eqns.append(eqn)
        operands = {v for v in eqn.invars if not isinstance(v, Literal)}
        if operands & others or eqn.effects:
            others.update(eqn.outvars)
        elif operands & timely:
            timely.update(eqn.outvars)
            name = eqn.primitive.name
            if name in _CHOICES:
                eqns.append(_is_chosen(eqn.invars[_CHOICES[name]], eqn.outvars[0]))
            found += eqns[-1].outvars if name in _CHOICES or name in _COMPARISONS else []
    return eqns, found


def _is_chosen(operand: Atom, result: Atom) -> JaxprEqn:
    (eqn,) = jax.make_jaxpr(jax.lax.eq)(result.aval, result.aval).jaxpr.eqns
    return eqn.replace(invars=[operand, result], outvars=[Var(eqn.outvars[0].aval)])
