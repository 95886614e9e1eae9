"""RATTLE, the symplectic method of constrained mechanics."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..equations.constraint_jacobian import mass_solve
from ..equations.mechanical import MechanicalODE
from ..systems import ConstrainedSystem, System, is_mechanism
from ..types import Args, BoolLike, Flat, Phase, State, Time
from .implicit import hermite
from .manifold import AbstractManifoldSolver, Formulation, or_nan, outcome, time_sign


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

    def refuse(self, system: System, formulation: Formulation, t0: Time, y0: State, args: Args) -> None:
        if not is_mechanism(system):
            raise ValueError("RATTLE takes a ConstrainedSystem; use SymmetricProjection for other systems.")
        if callable(system.mass):
            raise ValueError("RATTLE needs a constant mass matrix, but `mass` is a function; use SymmetricProjection.")
        if system.nonholonomic is not None:
            raise ValueError("RATTLE takes holonomic constraints only; use SymmetricProjection for nonholonomic ones.")
        if formulation.changes_field:
            raise ValueError(
                f"RATTLE has its own treatment of the constraints and takes no {type(formulation).__name__}."
            )
        if _force_uses_velocity(system, t0, y0, args):
            raise ValueError("RATTLE needs a force that does not depend on v; use SymmetricProjection.")

    def order(self, terms: diffrax.AbstractTerm) -> int:
        return 2

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Phase, args: MechanicalODE) -> None:
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Phase,
        args: MechanicalODE,
        solver_state: None,
        made_jump: BoolLike,
    ) -> Any:
        sign, h = time_sign(terms, t0, t1), terms.contr(t0, t1)
        q0, v0 = y0
        t0_, t1_ = sign * t0, sign * t1
        half = v0 + h / 2 * _free(args, t0_, q0, v0)
        chart = args.jacobian(t0_, y0)
        (q1, _), found = args.retract_along(t1_, (q0 + h * half, half), chart)
        half = (q1 - q0) / h
        free = half + h / 2 * _free(args, t1_, q1, half)
        # q₁ is on the manifold; what is restored is the velocity.
        (_, v1), settled = args.retract_along(t1_, (q1, free), args.jacobian(t1_, (q1, free)))
        found = found & settled
        y1 = or_nan(found, (q1, v1))
        return y1, None, hermite(terms, args, t0, t1, y0, y1), None, outcome(jnp.asarray(found))

    def retract(self, t: Time, y: Phase, ode: MechanicalODE) -> Any:
        y, found = ode.retract_along(t, y, ode.jacobian(t, y))
        return or_nan(found, y)


def _free(ode: MechanicalODE, t: Time, q: Flat, v: Flat) -> Any:
    return mass_solve(ode.mass(q), ode.force(t, q, v))


def _force_uses_velocity(system: ConstrainedSystem, t0: Time, y0: State, args: Args) -> bool:
    q, v = y0
    arrays, static = eqx.partition(args, eqx.is_array)
    jaxpr = jax.make_jaxpr(lambda v, q, a: system.force(t0, q, v, eqx.combine(a, static)))(v, q, arrays).jaxpr
    velocities = jaxpr.invars[: len(jax.tree.leaves(v))]
    used = [x for eqn in jaxpr.eqns for x in eqn.invars] + list(jaxpr.outvars)
    return any(x is velocity for x in used for velocity in velocities)
