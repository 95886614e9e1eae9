"""How one step is taken: one file a method, each a diffrax solver."""

from .abilities import (
    counts as counts,
    economical as economical,
    is_explicit as is_explicit,
    is_recomputable as is_recomputable,
    replays as replays,
    takes_residuals as takes_residuals,
)
from .bdf import BDF as BDF
from .dop853 import DOP853 as DOP853
from .failed_steps import WithoutFailedSteps as WithoutFailedSteps
from .felt import felt as felt
from .gauss import Gauss4 as Gauss4
from .implicit import AbstractImplicitSolver as AbstractImplicitSolver
from .manifold import AbstractManifoldSolver as AbstractManifoldSolver
from .midpoint import Midpoint as Midpoint
from .orthogonal_projection import OrthogonalProjection as OrthogonalProjection
from .radau import RadauIIA5 as RadauIIA5, RadauIIA9 as RadauIIA9, RadauIIA13 as RadauIIA13
from .radau_variable_order import Radau as Radau
from .rattle import RATTLE as RATTLE
from .residual_steps import AbstractResidualSolver as AbstractResidualSolver, first_step as first_step
from .selected_states import SelectedResiduals as SelectedResiduals, SelectedStates as SelectedStates
from .symmetric_projection import SymmetricProjection as SymmetricProjection
from .tangent_space import TangentSpace as TangentSpace
from .trapezoid import Trapezoid as Trapezoid
