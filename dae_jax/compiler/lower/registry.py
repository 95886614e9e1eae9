"""The table of primitives that can be compiled: one rule each."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..types import Aval, DType, Equation
from .dtypes import ALL


@dataclasses.dataclass(frozen=True)
class Rule:
    """How a primitive becomes instructions.

    - `lower(context, *operands, **params)` gives its result, or a list of its results. It may not fail for what `dtypes` and
      `requires` let pass.
    - `dtypes`: the types that each operand may have; further operands those of the last one.
    - `requires(eqn)`: why it cannot be compiled, in words, or `None`; asked of an equation whose types are declared.
    - `cost(eqn)`: about how many instructions it takes, where its operands are in registers.
    - `moves`: it gives numbers for numbers, without an instruction.
    - `by_memory`: also what is small goes through memory, where a place is found at run time.
    - `fuses`: its result in memory is computed where it is used.
    - `nested`: it runs jaxprs of its own, on operands in registers or in memory as they come.
    - `on_host`: it calls back to Python, which no GPU can.
    """

    lower: Callable[..., Any]
    dtypes: tuple[frozenset[str], ...]
    requires: Callable[[Any], str | None]
    cost: Callable[[Any], int]
    moves: bool
    by_memory: bool
    fuses: bool
    nested: bool
    on_host: bool

    def unsupported(self, eqn: Equation) -> str | None:
        """Why this equation cannot be compiled, or `None`."""
        for k, v in enumerate(eqn.invars):
            allowed = self.dtypes[min(k, len(self.dtypes) - 1)]
            if named(v.aval) not in allowed:
                return f"`{eqn.primitive.name}` of {named(v.aval)} is not written"
        for v in eqn.outvars:
            if named(v.aval) not in ALL:
                return f"{named(v.aval)} is no type of number that is compiled"
        return self.requires(eqn)


RULES: dict[str, Rule] = {}


def size(eqn: Equation) -> int:
    """An instruction for each entry of the results."""
    return sum(v.aval.size for v in eqn.outvars)


def free(_: object) -> int:
    """No instruction: entries in registers are only called differently."""
    return 0


def always(_: object) -> None:
    """Nothing more is required."""


def rule(
    names: str,
    dtypes: frozenset[str] | Sequence[frozenset[str]],
    *,
    requires: Callable[[Any], str | None] = always,
    cost: Callable[[Any], int] = size,
    moves: bool = False,
    by_memory: bool = False,
    fuses: bool = False,
    nested: bool = False,
    on_host: bool = False,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Enters a function as the rule of some primitives; what the arguments mean is said at `Rule`."""
    declared = (dtypes,) if isinstance(dtypes, frozenset) else tuple(dtypes)

    def enter(lower: Callable[..., Any]) -> Callable[..., Any]:
        entered = Rule(lower, declared, requires, cost, moves, by_memory, fuses, nested, on_host)
        RULES.update(dict.fromkeys(names.split(), entered))
        return lower

    return enter


def quoted(eqn: Equation) -> str:
    """An equation in short, as `f64[3] = sin f64[3]`."""
    outs, ins = (" ".join(v.aval.str_short(short_dtypes=True) for v in vs) for vs in (eqn.outvars, eqn.invars))
    return f"{outs} = {eqn.primitive.name} {ins}".strip()


def named(aval: Aval) -> str:
    """The name of a type of numbers."""
    return _name(getattr(aval, "dtype", None))


@functools.cache
def _name(dtype: DType) -> str:
    return np.dtype(dtype).name if isinstance(dtype, np.dtype | type) else str(dtype)
