"""RATTLE, the symplectic method of constrained mechanics."""

from typing import Any

import diffrax
import jax.numpy as jnp

from ..equations.constraint_jacobian import mass_solve
from .implicit import hermite
from .manifold import AbstractManifoldSolver, clock, or_nan, outcome


class RATTLE(AbstractManifoldSolver):
    """For M constant and forces f(t, q):

        ½ step:  v½ = v₀ + h/2 M⁻¹f(q₀) + N(q₀) λ,   q₁ = q₀ + h v½,   g(t₁, q₁) = 0,
        ½ step:  v₁ = v½ + h/2 M⁻¹f(q₁) + N(q₁) μ,   G(q₁) v₁ + g_t = 0,      N = M⁻¹Gᵀ.

    Order 2, symmetric and symplectic: the energy of a conservative system stays within O(h²) for exponentially long
    times. Fixed steps. Refused for a mass matrix that depends on q, a force that depends on v, and nonholonomic
    constraints.

    Source: E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, VII.1.4, eq. 1.26.
    """

    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        return 2

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        sign, h = clock(terms, t0, t1), terms.contr(t0, t1)
        q0, v0 = y0
        t0_, t1_ = sign * t0, sign * t1
        half = v0 + h / 2 * _free(args, t0_, q0, v0)
        chart = args.normals(t0_, y0)
        (q1, _), found = args.restore(t1_, (q0 + h * half, half), chart)
        half = (q1 - q0) / h
        free = half + h / 2 * _free(args, t1_, q1, half)
        # q₁ is on the manifold; what is restored is the velocity.
        (_, v1), settled = args.restore(t1_, (q1, free), args.normals(t1_, (q1, free)))
        found = found & settled
        y1 = or_nan(found, (q1, v1))
        return y1, None, hermite(terms, args, t0, t1, y0, y1), None, outcome(jnp.asarray(found))

    def land(self, t: Any, y: Any, ode: Any) -> Any:
        y, found = ode.restore(t, y, ode.normals(t, y))
        return or_nan(found, y)


def _free(ode: Any, t: Any, q: Any, v: Any) -> Any:
    return mass_solve(ode.mass(q), ode.force(t, q, v))
