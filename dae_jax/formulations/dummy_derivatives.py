"""Index reduction by Pantelides' algorithm and dummy derivatives (Pöll, Hafner and Heinzl, sec. 2.3)."""

from typing import Any

import jax
import jax.numpy as jnp

from ..residual import ResidualForm
from ..underlying import StructuralODE
from .differentiation import Differentiation


class DummyDerivatives(Differentiation):
    """The equations and their derivatives that structural analysis asks for, with as many *dummy derivatives*: entries of
    (y, ẏ, …) that are not integrated but found from the equations, at each stage of an explicit solver.

    Which ones is decided level by level, by complete pivoting on the system Jacobian at the start, and again at any step at
    which the choice has become worse than the best by more than a factor (hysteresis), inside one compiled solve: nothing
    is stopped or started anew. `stats["switches"]` counts the changes. A pendulum, for one, is
    integrated in x where it is low and in y where it is level.

    Source: C. C. Pantelides, SIAM J. Sci. Stat. Comput. 9 (1988), 213–231; S. E. Mattsson, G. Söderlind, SIAM J. Sci.
    Comput. 14 (1993), 677–692; the choice at run time: S. E. Mattsson, H. Olsson, H. Elmqvist, *Dynamic selection of states
    in Dymola*, Modelica Workshop 2000.
    """

    def encode(self, system: Any, t: Any, state: Any, args: Any = None, rank: int | None = None) -> Any:
        form = ResidualForm.of(system, t, state, args)
        ode = StructuralODE.of(form, jnp.result_type(*jax.tree.leaves(state)))
        return ode.encode(t, state), ode
