"""ẏ of a solution, and what moves with a time that is differentiated: the time of an event, or of a look at the solution between steps.

The polynomials between steps have slopes of a lower order than their values: with a time, a state moves by ẏ at it.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from ..equations.manifold_ode import Equations
from ..equations.residual_form import LARGE
from ..formulations import AbstractFieldFormulation, DummyDerivatives
from ..solvers.wrapping import AbstractWrapper
from ..types import Args, State, Time, Y
from .problem import Problem


if TYPE_CHECKING:
    from .program import Solve


class Rates(eqx.Module):
    """ẏ of the solution of `problem` by the method of `solve`, in the user's structure."""

    solve: "Solve"
    problem: Problem

    @classmethod
    def of(cls, solve: "Solve", problem: Problem) -> "Rates":
        """With the formulation towards the end of the problem as `solve` has it."""
        if not isinstance(solve.formulation, AbstractFieldFormulation):
            # From the same equations, those of massless coordinates too.
            solve = dataclasses.replace(solve, formulation=DummyDerivatives())
        return cls(dataclasses.replace(solve, saveat=diffrax.SaveAt(), event=None), problem)

    def __call__(self, t: Time, state: State, args: Args) -> Any:
        formulation: Any = self.solve.formulation
        y, ode = self.solve.encoded(dataclasses.replace(self.problem, t0=t, y0=state, args=args))
        decode = lambda t, y: formulation.decode(t, y, ode)
        return jax.jvp(decode, (t, y), (jnp.ones_like(t), formulation.field(t, y, ode)))[1]


def have_rates(problem: Problem) -> bool:
    """Whether ẏ is found: by equations that are stored as a matrix."""
    return sum(leaf.size for leaf in jax.tree.leaves(problem.y0)) <= LARGE


def chooses_steps(solve: "Solve") -> bool:
    """Whether the times of steps have no derivative. Fixed steps move with the ends."""
    return isinstance(solve.controller, diffrax.AbstractAdaptiveStepSizeController)


class Moving(eqx.Module):
    """`decode(t, y, ode)` of a y that is not known to move with t: its derivative by t is ẏ."""

    decode: Callable[..., Any]
    rates: Rates

    def __call__(self, t: Time, y: Y, ode: Equations) -> Any:
        return _moving(self.decode(lax.stop_gradient(t), y, ode), t, self.rates)


@eqx.filter_custom_jvp
def _moving(state: State, t: Time, rates: Rates) -> Any:  # noqa: ARG001
    return state


@_moving.def_jvp
def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    (state, t, rates), (dstate, dt, _) = primals, tangents
    if dt is None:
        return state, dstate
    state = _moving(state, t, rates)
    found = rates(t, state, rates.problem.args)
    return state, jax.tree.map(lambda dy, rate: plus(dy, rate * dt), dstate, found, is_leaf=lambda x: x is None)


def plus(dx: Any, more: Any) -> Any:
    """The sum of tangents, `None` being 0."""
    if dx is None or more is None:
        return more if dx is None else dx
    return dx + more


class Still(AbstractWrapper):
    """`solver`, whose dense output does not move with the time at which it is evaluated."""

    solver: diffrax.AbstractSolver

    @property
    def interpolation_cls(self) -> Any:
        return _StillPaths(self.solver.interpolation_cls)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        return self.solver.step(*args, **kwargs)


@dataclasses.dataclass(frozen=True)
class _StillPaths:
    of: Callable[..., Any]

    def __call__(self, t0: Time, t1: Time, **infos: Any) -> "_StillPath":
        return _StillPath(t0=t0, t1=t1, path=self.of(t0=t0, t1=t1, **infos))


class _StillPath(diffrax.AbstractLocalInterpolation):
    t0: Any
    t1: Any
    path: diffrax.AbstractLocalInterpolation

    def evaluate(self, t0: Time, t1: Time | None = None, left: bool = True) -> Any:
        return self.path.evaluate(lax.stop_gradient(t0), lax.stop_gradient(t1), left)
