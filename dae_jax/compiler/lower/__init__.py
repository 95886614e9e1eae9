"""A compiler for solves: jaxprs of small arrays as straight-line machine code, by LLVM."""

from .annotated import Annotated as Annotated
from .judge import annotate as annotate, unsupported as unsupported
from .module import compiled as compiled, written as written
from .uniformity import varying as varying
