"""Numbers and indices of a function that is being written."""

import dataclasses
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np


if TYPE_CHECKING:
    from .instructions import Instructions


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Value:
    """The result of an instruction: its name, the LLVM type of one number, and whether each lane has its own."""

    name: str
    kind: str
    lanes: bool = False


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Complex:
    """A complex number in two."""

    real: Any
    imag: Any


class Run(Value):
    """Indices that follow one another, one for each lane; as numbers they are written where they are asked for."""

    __slots__ = ("base", "code")

    def __init__(self, code: "Instructions", base: Value | int) -> None:
        for name, x in (("code", code), ("base", base), ("kind", "i64"), ("lanes", True)):
            object.__setattr__(self, name, x)

    @property
    def name(self) -> str:
        """Of the vector of all."""
        steps = ", ".join(f"i64 {k}" for k in range(self.code.width))
        first = self.code.text(self.code.copy(self.base, "i64"), "i64", True)
        return self.code.pure(f"add {self.code.type('i64', True)} {first}, <{steps}>", "i64", True).name


# A number: the result of an instruction, or known. An index: the same of an integer of 64 bits.
Number: TypeAlias = Value | Complex | np.number | np.bool_ | float
Index: TypeAlias = Value | int


def parts(x: Number) -> tuple[Any, Any]:
    """The real and the imaginary part of a number."""
    if isinstance(x, Complex):
        return x.real, x.imag
    if isinstance(x, np.complexfloating):
        return np.float64(x.real), np.float64(x.imag)
    return x, np.float64(0)
