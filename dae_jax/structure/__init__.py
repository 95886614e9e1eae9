"""Structure: what depends on what. Arrays and integers; nothing here knows a DAE system class."""

from .blocks import Block as Block, block_triangular as block_triangular
from .colouring import column_colouring as column_colouring, seed_matrix as seed_matrix
from .incidence import (
    Interpretation as Interpretation,
    dependence as dependence,
    dependence_patterns as dependence_patterns,
    interpreted as interpreted,
    is_linear as is_linear,
)
from .matching import (
    CoarseDecomposition as CoarseDecomposition,
    StructurallySingular as StructurallySingular,
    coarse_decomposition as coarse_decomposition,
    in_short as in_short,
    maximum_matching as maximum_matching,
    require_nonsingular as require_nonsingular,
)
from .ordering import (
    BorderedOrder as BorderedOrder,
    bandwidth as bandwidth,
    bordered_order as bordered_order,
    reverse_cuthill_mckee as reverse_cuthill_mckee,
)
from .pantelides import Pantelides as Pantelides, pantelides as pantelides
from .patterns import Pattern as Pattern, shape_of as shape_of, signature as signature, variables_of as variables_of
from .sigma import (
    SigmaAnalysis as SigmaAnalysis,
    highest_value_transversal as highest_value_transversal,
    jacobian_pattern as jacobian_pattern,
    sigma_method as sigma_method,
    variable_indices as variable_indices,
)
