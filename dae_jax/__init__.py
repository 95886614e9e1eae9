"""Differentiable solvers for differential-algebraic equations in JAX."""

import importlib as _importlib
import importlib.metadata as _metadata
from typing import TYPE_CHECKING as _TYPE_CHECKING, Any as _Any

from .analyse import Structure as Structure, analyse as analyse
from .compiler import configure as configure
from .consistent import consistent_state as consistent_state
from .diagnostics import (
    Drift as Drift,
    EquationDrift as EquationDrift,
    drift as drift,
    energy as energy,
    multipliers as multipliers,
)
from .driver.resets import Jump as Jump, Reset as Reset
from .explain import (
    MechanicalPlan as MechanicalPlan,
    Plan as Plan,
    ResidualPlan as ResidualPlan,
    StructuralPlan as StructuralPlan,
    explain as explain,
)
from .formulations import (
    GGL as GGL,
    AbstractFieldFormulation as AbstractFieldFormulation,
    AbstractFormulation as AbstractFormulation,
    AbstractResidualFormulation as AbstractResidualFormulation,
    Baumgarte as Baumgarte,
    Differentiation as Differentiation,
    DummyDerivatives as DummyDerivatives,
    Residual as Residual,
    StateSpace as StateSpace,
)
from .linalg.iterative import GMRES as GMRES
from .solution import (
    RESULTS as RESULTS,
    VIEWS as _VIEWS,
    AccuracyWarning as AccuracyWarning,
    DAESolution as DAESolution,
)
from .solve import daesolve as daesolve
from .solvers import (
    BDF as BDF,
    DOP853 as DOP853,
    RATTLE as RATTLE,
    AbstractManifoldSolver as AbstractManifoldSolver,
    AbstractResidualSolver as AbstractResidualSolver,
    Gauss4 as Gauss4,
    Midpoint as Midpoint,
    OrthogonalProjection as OrthogonalProjection,
    Radau as Radau,
    RadauIIA5 as RadauIIA5,
    RadauIIA9 as RadauIIA9,
    RadauIIA13 as RadauIIA13,
    SymmetricProjection as SymmetricProjection,
    TangentSpace as TangentSpace,
    Trapezoid as Trapezoid,
)
from .studies.baumgarte_loss import BaumgarteLoss as BaumgarteLoss, baumgarte_loss as baumgarte_loss
from .studies.grid import Grid as Grid, grid as grid
from .studies.identified import Identified as Identified
from .studies.identify import identify as identify
from .studies.sweep import sweep as sweep
from .studies.tune import Tuned as Tuned, tune as tune
from .systems import (
    ConstrainedSystem as ConstrainedSystem,
    ImplicitDAE as ImplicitDAE,
    SemiExplicitDAE as SemiExplicitDAE,
)


if _TYPE_CHECKING:
    from . import compiler as compiler, mechanisms as mechanisms, scenes as scenes
    from .app import plotting as plotting
    from .studies import reductions as reductions

_MODULES = {
    "compiler": ".compiler",
    "mechanisms": ".mechanisms",
    "plotting": ".app.plotting",
    "reductions": ".studies.reductions",
    "scenes": ".scenes",
}


_VIEWS["animate"] = lambda *arguments, **options: __getattr__("plotting").animate(*arguments, **options)


def __getattr__(name: str) -> _Any:
    """Modules that are imported when they are used, and the version."""
    if name in _MODULES:
        return _importlib.import_module(_MODULES[name], __name__)
    if name == "__version__":
        return _metadata.version(__name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES, "__version__"])
