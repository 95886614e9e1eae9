"""From LLVM's intermediate representation to machine code that XLA calls."""

from .programs import register as register
from .self_test import available as available
