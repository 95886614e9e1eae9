"""A function with what it will be compiled to."""

import dataclasses
from typing import Any

from jax.extend.core import ClosedJaxpr

from ..emit.target import Target
from ..jaxprs.inline import Inlining
from .registry import quoted


@dataclasses.dataclass(frozen=True)
class Note:
    """An equation as it will be written: how deep it is in loops and branches, whether its results may differ from lane to lane,
    where they are, and about how many instructions it takes.
    """

    depth: int
    eqn: Any
    varying: bool
    storage: str
    cost: int

    @property
    def equation(self) -> str:
        """The equation in short."""
        return quoted(self.eqn)

    def __str__(self) -> str:
        lanes = "varying" if self.varying else "uniform"
        return f"{self.cost:7d}  {lanes}  {self.storage:<9}  {'    ' * self.depth}{self.equation}"


@dataclasses.dataclass(frozen=True, eq=False)
class Annotated:
    """A function that can be compiled; `print` it.

    - `jaxpr`: the function without calls; `batched`: which of its arguments have a leading axis of lanes.
    - `inlined`: the jaxprs of its loops and branches without calls.
    - `cost`, `bytes`: about how many instructions it takes, and at most how many bytes its arrays, of one element.
    - `notes`: what will become of each equation.
    - `target`: the machine that it is compiled for.
    - `text`: the module, where it has been written already.
    """

    jaxpr: ClosedJaxpr
    batched: tuple[bool, ...]
    inlined: Inlining
    notes: tuple[Note, ...]
    bytes: int
    target: Target
    text: str | None = None

    @property
    def cost(self) -> int:
        return sum(note.cost for note in self.notes)

    @property
    def width(self) -> int:
        """How many lanes a vector has."""
        return self.target.width if any(self.batched) else 1

    def __str__(self) -> str:
        head = f"{self.cost} instructions, {self.bytes} bytes, {self.width} lanes"
        return "\n".join([head, *map(str, self.notes)])
