"""Symmetric projection (Pöll, Hafner and Heinzl, sec. 2.5)."""

from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ..equations.manifold_ode import ManifoldODE
from ..linalg import newton
from ..types import BoolLike, Flat, Time, Y
from ..validate.states import brief
from .implicit import AbstractImplicitSolver, hermite, predictor, stage_end, stage_residual, vector_field
from .manifold import AbstractManifoldSolver, or_nan, outcome, time_sign


class SymmetricProjection(AbstractManifoldSolver):
    """Off the manifold, a symmetric step Φ_h, and the same perturbation back on to it:

        ŷ₀ = y₀ + N(y₀) μ,   ŷ₁ = Φ_h(ŷ₀),   y₁ = ŷ₁ + N(y₁) μ,   H(t₁, y₁) = 0,

    the stages of Φ_h, y₁ and μ solved together by Newton's method. The step is symmetric, so that the energy of a
    reversible system has no secular trend. Fixed steps: variable ones would lose that.

    **Arguments**

    - `solver`: a symmetric one-step method, `Trapezoid()` as in the paper, `Midpoint()` or `Gauss4()`.

    Source: E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, V.4.1, algorithm 4.1.
    """

    needs_independent: ClassVar[bool] = True

    solver: AbstractImplicitSolver

    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def __check_init__(self) -> None:
        if not isinstance(self.solver, AbstractImplicitSolver):
            raise ValueError(
                f"SymmetricProjection takes a symmetric method, Trapezoid(), Midpoint() or Gauss4(), but got {brief(self.solver)}."
            )

    def order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Y, args: ManifoldODE) -> None:
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Y,
        args: ManifoldODE,
        solver_state: None,
        made_jump: BoolLike,
    ) -> Any:
        tableau = self.solver.tableau
        flat, unravel = ravel_pytree(y0)
        levels = jax.eval_shape(args.invariants, t0, y0)
        stages = len(tableau.implicit) * flat.size

        def residual(x: Flat, params: PyTree) -> Any:
            terms, args, t0, t1, y0, lengths = params
            sign = time_sign(terms, t0, t1)
            z, y1, mu = x[:stages], unravel(x[stages : stages + flat.size]), x[stages + flat.size :] / lengths
            start = args.displace(y0, args.jacobian(sign * t0, y0), mu)
            end = stage_end(tableau, terms, args, t0, t1, start, z)
            projected = args.displace(end, args.jacobian(sign * t1, y1), mu)
            return jnp.concatenate(
                [
                    stage_residual(tableau, terms, args, t0, t1, start, z),
                    ravel_pytree(y1)[0] - ravel_pytree(projected)[0],
                    *args.invariants(sign * t1, y1),
                ]
            )

        zero = jnp.zeros(sum(level.size for level in levels), flat.dtype)
        # The unknown is N μ over the length of N, a part of y: with heavy masses or small constraints μ itself is large.
        jacobian = args.jacobian(time_sign(terms, t0, t1) * t0, y0)
        moved = jax.jacfwd(lambda mu: ravel_pytree(args.displace(y0, jacobian, mu))[0])(zero)
        lengths = jnp.max(jnp.abs(moved), 0)
        lengths = jax.lax.stop_gradient(jnp.where(lengths > 0, lengths, 1))
        params = (terms, args, t0, t1, y0, lengths)
        euler = flat + ravel_pytree(vector_field(terms, args, t0, t1)(t0, y0))[0]
        x, found = newton(residual, jnp.concatenate([predictor(tableau, *params[:-1]), euler, zero]), params)
        y1 = or_nan(found, unravel(x[stages : stages + flat.size]))
        return y1, None, hermite(terms, args, t0, t1, y0, y1), None, outcome(found)

    def retract(self, t: Time, y: Y, ode: ManifoldODE) -> Any:
        y, found = ode.project(t, y)
        return or_nan(found, y)
