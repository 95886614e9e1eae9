"""Integration in a tangent chart that is built anew at each step: state-space form without a global chart."""

from typing import Any

import diffrax
import jax
from jaxtyping import PyTree

from ..equations.manifold_ode import ManifoldODE
from ..types import BoolLike, Time, Y
from .chart_steps import AbstractChartSolver
from .manifold import time_sign


class TangentSpace(AbstractChartSolver):
    """A step of an explicit solver in the coordinates of the tangent space at the step's start.

    With N = M⁻¹Aᵀ of the constraint Jacobian A at y₀ = (q₀, v₀) and the projection P = I − N(AN)⁻¹A along N (orthogonal in the metric
    of the mass matrix), a point of the manifold near y₀ is u = q₀ + P(q − q₀), w = P v, and

        u̇ = P v,   ẇ = P v̇,   q = u + N ν with g(t, q) = 0,   v = w + N κ with A(q) v + g_t = 0.

    The method works at the stages with points of the manifold only, so that nothing drifts, and needs no global chart.
    A step that leaves the reach of its chart ends in NaN, which an adaptive controller answers with a smaller step.

    **Arguments**

    - `solver`: an explicit Runge–Kutta solver of diffrax, or `DOP853`.

    Source: F. A. Potra, W. C. Rheinboldt, Mech. Struct. Mach. 19 (1991), 1–18; E. Hairer, C. Lubich, G. Wanner,
    *Geometric Numerical Integration*, IV.5.
    """

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Y, args: ManifoldODE) -> Any:
        return terms.vf(t0, y0, args)

    def along(self, dy: Y, chart: Any, ode: ManifoldODE) -> Any:
        return ode.tangent(dy, chart)

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        args: ManifoldODE,
        solver_state: PyTree,
        made_jump: BoolLike,
    ) -> Any:
        sign, h = time_sign(terms, t0, t1), terms.contr(t0, t1)
        ahead = jax.tree.map(lambda y, rate: y + h * rate, y0, solver_state)
        chart = args.lasting_jacobian(sign * t0, y0, sign * t1, ahead)
        return self.step_in(chart, terms, t0, t1, y0, args, solver_state, made_jump)
