"""Equations that switch with time, as `t % period < width` or a `clip` of the time do. Of steps in which they do so more than once, a
pulse between the points at which a method evaluates them is stepped over, and leaves no trace in the estimate of the error. Where
the time of a switch moves with what is differentiated, derivatives of the equations know nothing of it.
"""

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from ..compiler import Moving
from ..compiler._compat import low
from ..compiler.jaxprs.inline import Inlining
from ..compiler.jaxprs.walk import needed_for
from ..compiler.types import Arrays, Atom
from ..equations.manifold_ode import Equations
from ..solution import AccuracyWarning
from ..types import BoolScalar, Scalar, Time, Y
from .between_steps import announced
from .observed_steps import Step
from .problem import Problem, Program


# So many points of a step are looked at.
POINTS = 64
# In units of the relative rounding: shorter steps are not looked at.
RESOLVED = 1000
_COMPARISONS = frozenset({"lt", "le", "gt", "ge", "eq", "ne", "sign"})
# They choose among their operands; where it is this one, the result equals it.
_CHOICES = {"abs": 0, "clamp": 1, "max": 0, "min": 0}
# What jumps, if only in what follows; choices are continuous.
_SWITCHES = frozenset({"lt", "le", "gt", "ge", "sign", "floor", "ceil", "round", "rem"})
_LACKS = (
    "The equations switch at a time that depends on what is differentiated, as `t < a` does: where they jump there, the derivative "
    "lacks how the solution moves with that time. Make it known as it depends on that, "
    "`diffrax.ClipStepSizeController(controller, jump_ts=jnp.stack([a]))`, or make a `Reset` of it."
)


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
    t, states = problem.start[1], _states(problem)
    flat = Inlining()(low(jax.make_jaxpr(lambda t, states: _values(problem, t, states))(t, states)))
    every, found = _comparisons(flat)
    if not found:
        return None
    eqns, needed = needed_for(found, [eqn for eqn in every if not eqn.effects])
    constants = [(v, x) for v, x in zip(flat.jaxpr.constvars, flat.consts, strict=True) if v in needed]
    comparisons = flat.jaxpr.replace(
        constvars=[v for v, _ in constants], invars=flat.jaxpr.invars[:1], outvars=found, eqns=eqns
    )
    return SteppedOver(comparisons, [jnp.asarray(x) for _, x in constants])


def warn_of_moving_switches(program: Program, arrays: Arrays, moving: Moving) -> None:
    """Warns of comparisons of the time with what depends on those `arrays` of a solve that are `moving`, but where times that are
    announced move with these.
    """
    flags: list[Any] = list(moving)
    solve, _ = program.whole(flags)
    if any(announced(solve.controller)):
        return
    _, problem = program.whole(arrays)

    def values(arrays: Arrays, t: Scalar, states: Any) -> Any:
        return _values(program.whole(arrays)[1], t, states)

    flat = Inlining()(low(jax.make_jaxpr(values)(arrays, problem.t0, _states(problem))))
    marks = ["moving" if m else "" for m in moving], "time", ["state"] * (len(flat.jaxpr.invars) - len(arrays) - 1)
    for eqn, found in _marked(flat, jax.tree.leaves(marks)):
        if found >= {"time", "moving"} and "state" not in found and eqn.primitive.name in _SWITCHES:
            warnings.warn(_LACKS, AccuracyWarning, stacklevel=2)
            return


def _states(problem: Problem) -> list[Any]:
    """What the user's functions get of the state."""
    system, *start = problem.start
    return [c.values[1:-1] for c in system.calls(*start)]


def _values(problem: Problem, t: Scalar, states: list[Any]) -> list[Any]:
    """What they give."""
    system, *start = problem.start
    return [c.function(t, *s, problem.args) for c, s in zip(system.calls(*start), states, strict=True)]


def _marked(flat: ClosedJaxpr, marks: Sequence[str]) -> Iterator[tuple[JaxprEqn, frozenset[str]]]:
    """The equations with the marks of the arguments that they depend on."""
    of = {v: frozenset({mark} - {""}) for v, mark in zip(flat.jaxpr.invars, marks, strict=True)}
    for eqn in flat.jaxpr.eqns:
        found = frozenset[str]().union(*(of.get(v, ()) for v in eqn.invars if not isinstance(v, Literal)))
        found = found | {"state"} if eqn.effects else found
        of.update(dict.fromkeys(eqn.outvars, found))
        yield eqn, found


def _comparisons(flat: ClosedJaxpr) -> tuple[list[JaxprEqn], list[Any]]:
    """The equations, and the results of comparisons among them that depend on the first argument, the time, and on no other."""
    eqns, found = [], []
    for eqn, marks in _marked(flat, ["time", *["state"] * (len(flat.jaxpr.invars) - 1)]):
        eqns.append(eqn)
        name = eqn.primitive.name
        if marks == {"time"}:
            if name in _CHOICES:
                eqns.append(_is_chosen(eqn.invars[_CHOICES[name]], eqn.outvars[0]))
            found += eqns[-1].outvars if name in _CHOICES or name in _COMPARISONS else []
    return eqns, found


def _is_chosen(operand: Atom, result: Atom) -> JaxprEqn:
    (eqn,) = jax.make_jaxpr(jax.lax.eq)(result.aval, result.aval).jaxpr.eqns
    return eqn.replace(invars=[operand, result], outvars=[Var(eqn.outvars[0].aval)])
