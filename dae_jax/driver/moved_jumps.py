"""Jumps of the equations at times that are announced, and how the solution moves with these.

Where f jumps at τ from f⁻ to f⁺, y there has the derivative f⁻ − f⁺ by τ: the equations lead it until τ as before it, and from τ on as
after it. Steps end at τ, but do not move with it, and `where(t < tau, ...)` has no derivative by τ.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._compat import nextafter, prevbefore
from ..equations.manifold_ode import Equations
from ..equations.residual_form import LARGE
from ..formulations import AbstractFormulation
from ..solvers.wrapping import AbstractWrapper
from ..types import BoolLike, Scalar, Time, Y
from .between_steps import has_flow, step_of_no_length


class MovedJumps(AbstractWrapper):
    """`solver`, whose steps after a jump start from a point that moves with the time of it.

    - `jumps`: the user's times of them; `direction`: 1 or −1, as the solve goes.
    """

    solver: diffrax.AbstractSolver
    formulation: AbstractFormulation
    jumps: Float[Array, " jumps"]
    direction: Scalar

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
        if has_flow(self.formulation, y0):
            here = lax.stop_gradient(self.direction * t0)
            nearest = jnp.argmin(lax.stop_gradient(jnp.abs(self.jumps - here)))
            tau = jnp.where(made_jump, self.jumps[nearest], here)
            y0 = _across(y0, tau, jnp.asarray(made_jump), self.direction, self.formulation, args)
        else:
            y0 = _refused(y0, self.jumps)
        return self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)


def with_still_jumps(controller: Any) -> Any:
    """The controller, whose steps do not move with the times of jumps."""
    if getattr(controller, "jump_ts", None) is not None:
        controller = eqx.tree_at(lambda c: c.jump_ts, controller, replace_fn=lax.stop_gradient)
    if getattr(controller, "controller", None) is not None:
        controller = eqx.tree_at(lambda c: c.controller, controller, replace_fn=with_still_jumps)
    return controller


@eqx.filter_custom_jvp
def _across(
    y: Y,
    tau: Scalar,  # noqa: ARG001
    jumps: BoolLike,  # noqa: ARG001
    direction: Scalar,  # noqa: ARG001
    formulation: AbstractFormulation,  # noqa: ARG001
    ode: Equations,  # noqa: ARG001
) -> Any:
    """y, a point at τ, which moves with τ where the equations have a jump there."""
    return y


@_across.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    y, tau, jumps, direction, formulation, ode = primals
    of_y, of_tau, _, _, of_formulation, of_ode = tangents

    def through(y: Y, tau: Scalar, formulation: AbstractFormulation, ode: Equations) -> Any:
        beside = lambda number: tau + lax.stop_gradient(direction * number(direction * tau) - tau)
        before, after = beside(prevbefore), beside(nextafter)
        y = step_of_no_length(y, lax.stop_gradient(before), before, formulation, ode)
        return step_of_no_length(y, after, lax.stop_gradient(after), formulation, ode)

    def moved() -> Any:
        _, pushed = eqx.filter_jvp(through, (y, tau, formulation, ode), (of_y, of_tau, of_formulation, of_ode))
        return _filled(y, pushed)

    # Also where τ does not change: a derivative by it that is taken later on counts.
    return _across(*primals), lax.cond(jumps, moved, lambda: _filled(y, of_y))


@eqx.filter_custom_jvp
def _refused(y: Y, jumps: Float[Array, " jumps"]) -> Any:  # noqa: ARG001
    """y, without a derivative by the times of jumps."""
    return y


@_refused.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    if tangents[1] is not None:
        raise NotImplementedError(
            f"Residuals of more than {LARGE} unknowns have no derivative by the times in `jump_ts`: where nothing but a slope jumps, "
            "announce `jax.lax.stop_gradient(times)`; else start again there by a `Reset` with the condition `t - time`."
        )
    return _refused(*primals), _filled(primals[0], tangents[0])


def _filled(y: Y, change: Any) -> Any:
    if change is None:
        return jax.tree.map(jnp.zeros_like, y)
    return jax.tree.map(lambda x, change: jnp.zeros_like(x) if change is None else change, y, change)
