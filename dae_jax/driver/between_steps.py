"""Points of a solve, and how they move with their time.

Steps have ends that are chosen, and between them polynomials, whose slopes are of a lower order than their values; what a step's end
has to do with its size is of a lower order, too. So the derivative of a point by its time is that of the flow of the equations.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._compat import nextafter, prevbefore
from ..equations.manifold_ode import Equations
from ..equations.residual_form import LARGE
from ..equations.shown_rates import shown_rates
from ..formulations import AbstractFieldFormulation, AbstractFormulation
from ..solvers.wrapping import AbstractWrapper
from ..types import BoolLike, Scalar, Time, Y


def has_flow(formulation: AbstractFormulation, y: Y) -> bool:
    """Whether points of the solver's move with a field; that of a large system's residual would be dense."""
    return isinstance(formulation, AbstractFieldFormulation) or sum(x.size for x in jax.tree.leaves(y)) <= LARGE


class Flow(eqx.Module):
    """Where points move with their time. `later`: a derivative that is not by it may be differentiated by it later on.
    `raised`: whether a reset may have raised the index of the equations.
    """

    formulation: AbstractFormulation
    later: bool = eqx.field(static=True, default=True)
    raised: bool = eqx.field(static=True, default=False)


@eqx.filter_custom_jvp
def along_flow(y: Y, t: Time, flow: Flow, ode: Equations) -> Any:  # noqa: ARG001
    """y, a point at t that is still: it moves with t as the equations say. Derivatives by t are right to the fourth."""
    return y


@along_flow.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    ends = lambda t: (lax.stop_gradient(t), t)
    return along_flow(*primals), _moved(ends, primals, tangents)


@eqx.filter_custom_jvp
def held(y: Y, t: Time, flow: Flow, ode: Equations) -> Any:  # noqa: ARG001
    """y, a point that moves with t, as one at a time that is still: where the equations lead it from t. Derivatives as above."""
    return y


@held.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    ends = lambda t: (t, lax.stop_gradient(t))
    return held(*primals), _moved(ends, primals, tangents)


def _moved(ends: Callable[[Time], tuple[Time, Time]], primals: Any, tangents: Any) -> Any:
    """How the end of a step of the classical method moves whose length is 0. It is written out: of functions with a rule of their own
    JAX forgets the rule in what is linear.
    """
    (y, _, flow, _), (change, of_t, *_) = primals, tangents
    if of_t is None and not flow.later:
        return jax.tree.map(lambda y, dy: jnp.zeros_like(y) if dy is None else dy, y, change)

    def step(y: Y, t: Time, flow: Flow, ode: Equations) -> Any:
        start, end = ends(t)
        of_residual = functools.partial(shown_rates, raised=flow.raised)
        h, formulation = jnp.asarray(end - start), flow.formulation
        field: Any = formulation.field if isinstance(formulation, AbstractFieldFormulation) else of_residual
        plus = lambda h, y, rates: jax.tree.map(lambda y, rate: y + h * rate, y, rates)

        # A loop, as the field may be large, and its derivatives are larger.
        def stage(carry: tuple[Y, Y], at: tuple[Scalar, Scalar]) -> Any:
            rates, total = carry
            fraction, weight = at
            rates = field(start + fraction * h, plus(fraction * h, y, rates), ode)
            return (rates, plus(weight, total, rates)), None

        zero = jax.tree.map(jnp.zeros_like, y)
        stages = jnp.array([0, 0.5, 0.5, 1], h.dtype), jnp.array([1, 2, 2, 1], h.dtype) / 6
        (_, total), _ = lax.scan(stage, (zero, zero), stages)
        return plus(h, y, total)

    found, pushed = eqx.filter_jvp(step, primals, tangents)
    return jax.tree.map(lambda x, change: jnp.zeros_like(x) if change is None else change, found, pushed)


def announced(controller: Any) -> list[Any]:
    """The times of jumps that a controller knows of, and those of what it is wrapped around."""
    if controller is None:
        return []
    own = getattr(controller, "jump_ts", None)
    return ([] if own is None else [own]) + announced(getattr(controller, "controller", None))


def jump_times(controller: Any) -> Any:
    """All of these; `None` where there are none."""
    known = announced(controller)
    return jnp.concatenate(known) if known else None


def beside(t: Scalar, jumps: Any, left: bool, path: diffrax.DenseInterpolation) -> Any:
    """t, or where it is one of the `jumps` the number beside it on the side where the solve comes from (`left`) or goes to: what holds
    at the jump itself may be either.
    """
    if jumps is None:
        return t
    here = path.direction * t
    aside = prevbefore(here) if left else nextafter(here)
    moves = jnp.any(t == jumps) & (aside >= path.ts[0]) & (aside <= path.ts[path.ts_size - 1])
    return t + lax.stop_gradient(jnp.where(moves, path.direction * aside - t, 0))


def change_of_jump(jumps: Any, t: Scalar) -> Any:
    """How the jump that is nearest to t moves, as a number that is 0."""
    nearest = jumps[jnp.argmin(jnp.abs(jumps - t))]
    return nearest - lax.stop_gradient(nearest)


class StillSteps(AbstractWrapper):
    """`solver`, whose steps do not move with the times of their ends. Where a jump that is announced moves, the point after it is where
    the flow of before leads to, and that of after leads back from.
    """

    solver: diffrax.AbstractSolver
    flow: Flow
    jumps: Any = None

    @property
    def interpolation_cls(self) -> Any:
        return _still(self.solver.interpolation_cls)

    def init(self, terms: Any, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        return self.solver.init(terms, *lax.stop_gradient((t0, t1)), y0, args)

    def step(
        self,
        terms: Any,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Any,
        made_jump: BoolLike,
    ) -> Any:
        t0, t1 = lax.stop_gradient((t0, t1))
        if made_jump is not False and self.jumps is not None and self.jumps.size:
            y0 = lax.cond(made_jump, lambda: self._across(terms.direction, t0, y0, args), lambda: y0)
        return self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)

    def _across(self, direction: Any, t: Time, y: Any, ode: Equations) -> Any:
        """y, from before the jump that t is just after, to t."""
        change = change_of_jump(self.jumps, direction * t)
        before = direction * prevbefore(prevbefore(jnp.asarray(t)))
        return held(along_flow(y, before + change, self.flow, ode), direction * t + change, self.flow, ode)


@functools.lru_cache(maxsize=64)
def _still(polynomials: Any) -> Any:
    """These, without derivatives by times."""
    return functools.partial(_Still, polynomials)


class _Still(diffrax.AbstractLocalInterpolation):
    t0: Any
    t1: Any
    polynomial: Any

    def __init__(self, polynomials: Any, t0: Time, t1: Time, **dense: Any) -> None:
        self.t0, self.t1 = lax.stop_gradient((t0, t1))
        self.polynomial = polynomials(t0=self.t0, t1=self.t1, **dense)

    def evaluate(self, t0: Time, t1: Time | None = None, left: bool = True) -> Any:
        return self.polynomial.evaluate(*lax.stop_gradient((t0, t1)), left)
