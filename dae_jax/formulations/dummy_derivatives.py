"""Index reduction by Pantelides' algorithm and dummy derivatives (Pöll, Hafner and Heinzl, sec. 2.3)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ..equations.constraint_jacobian import Rank
from ..equations.independent import independent
from ..equations.index1_form import Index1Form
from ..equations.linearised import LinearisedResidual
from ..equations.residual_form import ResidualForm
from ..equations.state_selection import selection
from ..equations.structural_ode import StructuralODE
from ..systems import System
from ..types import Args, State, Time, Y
from .interface import AbstractFieldFormulation, AbstractResidualFormulation


class DummyDerivatives(AbstractFieldFormulation):
    """The equations and their derivatives that structural analysis asks for, with as many *dummy derivatives*: entries of
    (y, ẏ, …) that are not integrated but found from the equations: at each stage of an explicit solver by Newton's method, by
    `RadauIIA5` and `BDF`, for stiff systems, as the algebraic variables of a system of index 1.

    Where an algebraic equation has several roots, the one is followed that the motion from the start leads to: an explicit solver
    begins Newton's method at the integral of their derivatives, and rejects a step from which another root is about as near. Where
    roots meet, the solve ends with an error.

    Which ones is decided level by level, by complete pivoting on the system Jacobian at the start, and again at any step at
    which the choice has become worse than the best by more than a factor (hysteresis), inside one compiled solve: nothing
    is stopped or started anew. `stats["switches"]` counts the changes. A pendulum, for one, is
    integrated in x where it is low and in y where it is level.

    Source: C. C. Pantelides, SIAM J. Sci. Stat. Comput. 9 (1988), 213–231; S. E. Mattsson, G. Söderlind, SIAM J. Sci.
    Comput. 14 (1993), 677–692; the choice at run time: S. E. Mattsson, H. Olsson, H. Elmqvist, *Dynamic selection of states
    in Dymola*, Modelica Workshop 2000.
    """

    inverts_mass: ClassVar[bool] = False
    needs_independent: ClassVar[bool] = True
    selects_states: ClassVar[bool] = True

    @property
    def keeps(self) -> tuple[bool, bool]:
        return True, True

    def encode(self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None) -> Any:
        if rank is not None:
            system = independent(system, t, state, args, rank)
        form = ResidualForm.of(system, t, state, args)
        ode = StructuralODE.of(form, jnp.result_type(*jax.tree.leaves(state)))
        return ode.encode(t, state), ode

    def field(self, t: Time, y: Y, ode: StructuralODE) -> Any:
        return ode.field(t, y)


class ReducedResidual(AbstractResidualFormulation):
    """The equations of `DummyDerivatives` for a solver of residuals: see `Index1Form`."""

    inverts_mass: ClassVar[bool] = False
    needs_independent: ClassVar[bool] = True

    def named(self, system: System) -> str:
        return DummyDerivatives.__name__

    @property
    def keeps(self) -> tuple[bool, bool]:
        return True, True

    def encode(
        self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, LinearisedResidual]:
        y, ode = DummyDerivatives().encode(system, t, state, args, rank)
        form = Index1Form(ode, selection(ode.orders, ode.leading(t, y))[0])
        z = form.encode(t, y)
        # The selection changes: the structure is that of all of them.
        linearised = LinearisedResidual.of(form.with_all_candidates(y.dtype), z)
        return z, eqx.tree_at(lambda p: p.form, linearised, form).starting(t, z)
