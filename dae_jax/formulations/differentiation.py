"""Index reduction by differentiation and substitution (Pöll, Hafner and Heinzl, sec. 2.1)."""

from typing import Any, ClassVar

from ..equations.constraint_jacobian import Rank
from ..equations.manifold_ode import ManifoldODE
from ..equations.structural_ode import underlying_ode
from ..systems import System
from ..types import Args, State, Time, Y
from .interface import AbstractFieldFormulation


class Differentiation(AbstractFieldFormulation):
    """The underlying ODE itself: the constraint is differentiated until the multipliers can be eliminated,

        v̇ = M⁻¹(f − Aᵀλ),   A M⁻¹ Aᵀ λ = A M⁻¹ f + γ.

    The constraints hold at the start and are then invariants of the exact flow only: with a solver that does not
    restore them the error in g grows like t² and that in ġ like t (*drift-off*).
    """

    changes_field: ClassVar[bool] = False

    def encode(
        self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, ManifoldODE]:
        return underlying_ode(system, t, state, args, rank)

    def field(self, t: Time, y: Y, ode: ManifoldODE) -> Any:
        return ode.field(t, y)
