"""A compiler for solves: jaxprs of small arrays as straight-line machine code, by LLVM."""

from .compiler import compiled as compiled, hindrances as hindrances
from .dependence import depends as depends
