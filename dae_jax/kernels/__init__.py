"""How small functions become fast machine code: scalar arithmetic and single kernels."""

from .one_kernel import configure as configure, hindrances as hindrances, one_kernel as one_kernel
from .scalarise import scalarise as scalarise
from .subroutine import subroutine as subroutine
