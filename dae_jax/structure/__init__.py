"""Structure: what depends on what. Arrays and integers; nothing here knows a DAE system class."""

from .blocks import Block as Block
from .blocks import block_triangular as block_triangular
from .colouring import column_colouring as column_colouring
from .colouring import seed_matrix as seed_matrix
from .incidence import dependence as dependence
from .incidence import signature as signature
from .matching import (
    CoarseDecomposition as CoarseDecomposition,
)
from .matching import (
    StructurallySingular as StructurallySingular,
)
from .matching import (
    coarse_decomposition as coarse_decomposition,
)
from .matching import (
    maximum_matching as maximum_matching,
)
from .ordering import (
    BorderedOrder as BorderedOrder,
)
from .ordering import (
    bandwidth as bandwidth,
)
from .ordering import (
    bordered_order as bordered_order,
)
from .ordering import (
    reverse_cuthill_mckee as reverse_cuthill_mckee,
)
from .pantelides import Pantelides as Pantelides
from .pantelides import pantelides as pantelides
from .sigma import SigmaAnalysis as SigmaAnalysis
from .sigma import jacobian_pattern as jacobian_pattern
from .sigma import sigma_method as sigma_method
