"""How small functions become fast machine code: scalar arithmetic and single kernels."""

from . import waiting as waiting
from ._compat import (
    at_ease as at_ease,
    evaluated_now as evaluated_now,
    scan_counts as scan_counts,
    trace_state_clean as trace_state_clean,
)
from .fallbacks import left_to_xla as left_to_xla
from .jaxprs.gathers import gathered as gathered, windows as windows
from .jaxprs.numbers import on_numbers as on_numbers
from .jaxprs.polynomials import Polynomial as Polynomial, polynomials as polynomials
from .jaxprs.scalarise import scalarise as scalarise
from .jaxprs.unchecked import without_checks as without_checks
from .jaxprs.walk import (
    ALL_CALLS as ALL_CALLS,
    WITH_DERIVATIVE as WITH_DERIVATIVE,
    called as called,
    equations as equations,
    is_large as is_large,
)
from .jit import Jitted as Jitted, compiles as compiles, jit as jit
from .kernel_call import (
    Decision as Decision,
    decision as decision,
    hindrances as hindrances,
    unsupported as unsupported,
)
from .linear_map import Moving as Moving
from .one_kernel import (
    PullBack as PullBack,
    inexact as inexact,
    one_kernel as one_kernel,
)
from .quickly import quickly_compiled as quickly_compiled
from .settings import (
    configure as configure,
    one_kernel_enabled as one_kernel_enabled,
    processors as processors,
)
from .subroutine import subroutine as subroutine
