"""Which equations are integrated: one file a formulation.

Each has `encode(system, t, state, args) → (y, ode)`, `term()` and `decode(t, y, ode) → state`; `ode` travels as the
`args` of `diffrax.diffeqsolve`.
"""

from .baumgarte import Baumgarte as Baumgarte
from .choice import why_not_as_written as why_not_as_written
from .differentiation import Differentiation as Differentiation
from .dummy_derivatives import DummyDerivatives as DummyDerivatives, ReducedResidual as ReducedResidual
from .interface import (
    AbstractFieldFormulation as AbstractFieldFormulation,
    AbstractFormulation as AbstractFormulation,
    AbstractResidualFormulation as AbstractResidualFormulation,
)
from .residual import GGL as GGL, Residual as Residual
from .state_space import StateSpace as StateSpace
