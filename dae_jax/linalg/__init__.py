"""Linear and nonlinear equations of a few unknowns, solved in plain arithmetic; LAPACK above a measured size."""

from .contraction import solve_contraction as solve_contraction
from .definite_factors import Factors as Factors, factorised as factorised, solve_with as solve_with
from .dense import (
    determinant_sign as determinant_sign,
    least_sign as least_sign,
    row_products as row_products,
    signed_log_determinant as signed_log_determinant,
    solve as solve,
)
from .elimination import Elimination as Elimination, elimination as elimination, powers as powers, take as take
from .lineax_solvers import SmallCholesky as SmallCholesky, SmallLU as SmallLU
from .newton import (
    amplified_roundoff as amplified_roundoff,
    fixed_point as fixed_point,
    implicit_root as implicit_root,
    newton as newton,
    relative_change as relative_change,
    roundoff as roundoff,
    while_progress as while_progress,
)
from .norm import error_norm as error_norm, rms_norm as rms_norm
from .semidefinite import semidefinite_solve as semidefinite_solve, smallest_pivot as smallest_pivot
from .sparse_definite import SparseDefinite as SparseDefinite
from .tearing import Tearing as Tearing, tearing as tearing
