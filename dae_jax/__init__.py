"""Differentiable solvers for differential-algebraic equations in JAX."""

import importlib as _importlib
import importlib.metadata as _metadata
from typing import Any as _Any

from .analyse import Structure as Structure, analyse as analyse
from .baumgarte_loss import BaumgarteLoss as BaumgarteLoss, baumgarte_loss as baumgarte_loss
from .compiler import configure as configure
from .diagnostics import (
    Drift as Drift,
    EquationDrift as EquationDrift,
    drift as drift,
    energy as energy,
    multipliers as multipliers,
)
from .explain import (
    MechanicalPlan as MechanicalPlan,
    Plan as Plan,
    ResidualPlan as ResidualPlan,
    StructuralPlan as StructuralPlan,
    explain as explain,
)
from .formulations import (
    GGL as GGL,
    AbstractFormulation as AbstractFormulation,
    Baumgarte as Baumgarte,
    Differentiation as Differentiation,
    DummyDerivatives as DummyDerivatives,
    Residual as Residual,
    StateSpace as StateSpace,
)
from .initialise import consistent_state as consistent_state
from .jumps import Jump as Jump
from .solution import RESULTS as RESULTS, DAESolution as DAESolution
from .solve import daesolve as daesolve
from .solvers import (
    BDF as BDF,
    DOP853 as DOP853,
    RATTLE as RATTLE,
    Gauss4 as Gauss4,
    Midpoint as Midpoint,
    OrthogonalProjection as OrthogonalProjection,
    RadauIIA5 as RadauIIA5,
    SymmetricProjection as SymmetricProjection,
    TangentSpace as TangentSpace,
    Trapezoid as Trapezoid,
)
from .sweep import Grid as Grid, grid as grid, sweep as sweep
from .systems import (
    ConstrainedSystem as ConstrainedSystem,
    ImplicitDAE as ImplicitDAE,
    SemiExplicitDAE as SemiExplicitDAE,
)
from .tune import Tuned as Tuned, tune as tune


_MODULES = ("plotting", "reductions", "scenes")


def __getattr__(name: str) -> _Any:
    """Modules that are imported when they are used, and the version."""
    if name in _MODULES:
        return _importlib.import_module(f".{name}", __name__)
    if name == "__version__":
        return _metadata.version(__name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES, "__version__"])
