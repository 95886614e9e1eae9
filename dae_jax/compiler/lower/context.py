"""What the rule of a primitive works with."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from jax.extend.core import ClosedJaxpr
from jax.typing import ArrayLike

from ..types import Equation
from .arrays import Fused, Operand, View
from .instructions import Instructions
from .memory import Memory


class Lowering(Protocol):
    """A function that is being written: `run` writes a jaxpr, `call` a call of one, with arrays as entries (numpy arrays of
    objects), as views of memory, or yet to be computed.
    """

    code: Instructions
    memory: Memory

    def run(self, closed: ClosedJaxpr, args: list[Operand]) -> list[Operand]: ...
    def call(self, closed: ClosedJaxpr, args: list[Operand]) -> list[Operand]: ...
    def equation(self, eqn: Equation, args: list[Operand], into_loop: bool = False) -> list[Operand]: ...
    def constant(self, x: ArrayLike) -> Operand: ...


class Context:
    """An equation, and the function that its instructions are written into.

    - `code`, `memory`, `run`, `call`: what instructions, arrays, inner jaxprs and procedures are written with.
    - `large`: whether the operands may be in memory and the result shall be; else the operands are entries in registers.
    - `out`, `outs`, `to`: the aval of the result, of all results, and the result's type of number.
    - `dtype`, `dtypes`: the type of the last operand, and of each.
    """

    def __init__(self, lowering: Lowering, eqn: Equation, large: bool) -> None:
        self.code: Instructions = lowering.code
        self.memory: Memory = lowering.memory
        self.run: Callable[[ClosedJaxpr, list[Operand]], list[Operand]] = lowering.run
        self.call: Callable[[ClosedJaxpr, list[Operand]], list[Operand]] = lowering.call
        self.eqn, self.name, self.large = eqn, eqn.primitive.name, large
        self.outs = [v.aval for v in eqn.outvars]
        self.dtypes = [np.dtype(v.aval.dtype) for v in eqn.invars]
        self.out: Any = self.outs[0] if self.outs else None
        self.to = np.dtype(self.outs[0].dtype) if self.outs else np.dtype(bool)
        self.dtype = self.dtypes[-1] if self.dtypes else self.to

    def array(self, x: Operand, k: int = 0) -> View | Fused:
        """Operand k as an array that is not entries."""
        return self.memory.view(x, self.dtypes[k]) if isinstance(x, np.ndarray) else x

    def entries(self, x: Operand) -> np.ndarray:
        """An operand as entries."""
        return self.memory.entries(x)

    def view(self, x: Operand, k: int = 0) -> View:
        """Operand k as an array in memory."""
        return self.memory.view(x, self.dtypes[k])
