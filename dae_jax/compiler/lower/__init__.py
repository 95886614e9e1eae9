"""A compiler for solves: jaxprs of small arrays as straight-line machine code, by LLVM."""

from .module import compiled as compiled, hindrances as hindrances
from .uniformity import varying as varying
