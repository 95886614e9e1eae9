"""How small functions become fast machine code: scalar arithmetic and single kernels."""

from . import waiting as waiting
from .gathers import gathered as gathered, windows as windows
from .jaxprs import equations as equations, is_large as is_large
from .kernel_call import hindrances as hindrances
from .numbers import on_numbers as on_numbers
from .one_kernel import (
    PullBack as PullBack,
    configure as configure,
    inexact as inexact,
    one_kernel as one_kernel,
    one_kernel_enabled as one_kernel_enabled,
)
from .polynomials import Polynomial as Polynomial, polynomials as polynomials
from .scalarise import scalarise as scalarise
from .subroutine import subroutine as subroutine
from .unchecked import without_checks as without_checks
