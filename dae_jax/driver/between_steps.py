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
from jaxtyping import PyTree

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


def along_flow(y: Y, t: Time, formulation: AbstractFormulation, ode: Equations) -> Any:
    """y, a point at t that is still: it moves with t as the equations say."""
    return _later(y, t, (formulation, ode), _rates)


def held(y: Y, t: Time, formulation: AbstractFormulation, ode: Equations) -> Any:
    """y, a point that moves with t, as one at a time that is still: where the flow leads it from t."""
    return _until(y, t, (formulation, ode), _rates)


def _rates(t: Time, y: Y, equations: tuple[AbstractFormulation, Any]) -> Any:
    formulation, ode = equations
    return formulation.field(t, y, ode) if isinstance(formulation, AbstractFieldFormulation) else shown_rates(ode, t, y)


# Φ(y), the flow to t from where t is, and from t to there: y itself, with all derivatives. Φ′(y) δy is the flow of (y, δy).
@eqx.filter_custom_jvp
def _later(y: Y, t: Time, equations: PyTree, rates: Callable[..., Any]) -> Any:  # noqa: ARG001
    return y


@_later.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    y, t, equations, rates = primals
    dy, dt, changes, _ = tangents
    if dt is None:
        return y, dy
    y, moved = _later((y, _whole(dy, y)), t, (equations, _whole(changes, equations)), functools.partial(_pushed, rates))
    return y, jax.tree.map(lambda a, b: a + dt * b, moved, rates(t, y, equations))


@eqx.filter_custom_jvp
def _until(y: Y, t: Time, equations: PyTree, rates: Callable[..., Any]) -> Any:  # noqa: ARG001
    return y


@_until.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    y, t, equations, rates = primals
    dy, dt, changes, _ = tangents
    if dt is None:
        return y, dy
    change = jax.tree.map(lambda a, b: a - dt * b, _whole(dy, y), rates(t, y, equations))
    return _until((y, change), t, (equations, _whole(changes, equations)), functools.partial(_pushed, rates))


def _pushed(rates: Callable[..., Any], t: Time, y: Any, equations: Any) -> Any:
    """The rates of (y, δy), for changes of the equations beside."""
    return eqx.filter_jvp(lambda *at: rates(t, *at), (y[0], equations[0]), (y[1], equations[1]))


def _whole(changes: PyTree, primals: PyTree) -> Any:
    """The changes of numbers, zeros where there are none."""
    numbers = eqx.filter(primals, eqx.is_inexact_array)
    none = lambda x: x is None
    return eqx.combine(changes, jax.tree.map(lambda x: x if none(x) else jnp.zeros_like(x), numbers, is_leaf=none))


def jump_times(controller: Any) -> Any:
    """The times at which a controller knows of jumps, and what it is wrapped around; `None` where there are none."""
    if controller is None:
        return None
    own, inner = getattr(controller, "jump_ts", None), jump_times(getattr(controller, "controller", None))
    known = [x for x in (own, inner) if x is not None]
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


class StillSteps(AbstractWrapper):
    """`solver`, whose steps do not move with the times of their ends."""

    solver: diffrax.AbstractSolver

    @property
    def interpolation_cls(self) -> Any:
        return _still(self.solver.interpolation_cls)

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
        return self.solver.step(terms, *lax.stop_gradient((t0, t1)), y0, args, solver_state, made_jump)


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
