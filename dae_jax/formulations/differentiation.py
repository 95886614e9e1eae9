"""Index reduction by differentiation and substitution (Pöll, Hafner and Heinzl, sec. 2.1)."""

import abc
from typing import Any, ClassVar

import diffrax
import equinox as eqx

from ..equations.manifold_ode import ManifoldODE
from ..equations.structural_ode import underlying_ode


class AbstractFormulation(eqx.Module):
    """Which equations of a system are integrated.

    For those who call `diffrax.diffeqsolve` themselves:

        y0, ode = formulation.encode(system, t0, state, args)
        sol = diffrax.diffeqsolve(formulation.term(), solver, t0, t1, dt0, y0, args=ode)
        state = formulation.decode(t, y, ode)

    `inverts_mass`: whether M⁻¹ is needed, so that no coordinate can be massless; `keeps`: whether g and (ġ, h) hold
    whatever the solver does.
    """

    inverts_mass: ClassVar[bool] = True

    @property
    def keeps(self) -> tuple[bool, bool]:
        return False, False

    @abc.abstractmethod
    def encode(
        self, system: Any, t: Any, state: Any, args: Any = None, rank: int | None = None
    ) -> tuple[Any, ManifoldODE]:
        """The integration variables of `state`, and the underlying ODE."""

    def term(self) -> diffrax.ODETerm:
        """The vector field (t, y, ode) ↦ ẏ for diffrax."""
        return diffrax.ODETerm(self.field)

    @abc.abstractmethod
    def field(self, t: Any, y: Any, ode: Any) -> Any:
        """ẏ at (t, y)."""

    def decode(self, t: Any, y: Any, ode: Any) -> Any:
        """The state in the user's structure."""
        return ode.decode(t, y)


class Differentiation(AbstractFormulation):
    """The underlying ODE itself: the constraint is differentiated until the multipliers can be eliminated,

        v̇ = M⁻¹(f − Aᵀλ),   A M⁻¹ Aᵀ λ = A M⁻¹ f + γ.

    The constraints hold at the start and are then invariants of the exact flow only: with a solver that does not
    restore them the error in g grows like t² and that in ġ like t (*drift-off*).
    """

    def encode(
        self, system: Any, t: Any, state: Any, args: Any = None, rank: int | None = None
    ) -> tuple[Any, ManifoldODE]:
        return underlying_ode(system, t, state, args, rank)

    def field(self, t: Any, y: Any, ode: Any) -> Any:
        return ode.field(t, y)
