"""Jaxprs written as instructions, equation by equation, each by the rule of its primitive."""

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr
from jax.typing import ArrayLike

from ..emit.target import Target
from ..jaxprs.inline import Inlining
from ..jaxprs.numbers import is_on_numbers
from ..jaxprs.objects import are_known, objects
from ..thresholds import THRESHOLDS
from ..types import Aval, Equation
from . import rules as rules
from .arrays import Buffer, Operand, View, row_major
from .context import Context
from .dtypes import parts_of
from .environment import Environment
from .instructions import Instructions
from .memory import Memory
from .procedures import Procedures
from .registry import RULES, Rule, quoted


class TooLarge(Exception):
    """More instructions have been written than may be."""


class LoweringError(RuntimeError):
    """A rule has failed for an equation that it takes by what it declares."""


class Lowering:
    """A function that is being written.

    An entry that is known is a numpy scalar. `limit`: after how many instructions it is given up with `TooLarge`.
    """

    def __init__(
        self,
        width: int,
        always_copies: bool,
        limit: float,
        inlined: Inlining,
        prefix: str = "",
        target: Target | None = None,
    ) -> None:
        self.code = Instructions(width, prefix, target)
        self.memory = Memory(self.code, always_copies)
        self.procedures = Procedures()
        self.inlined = inlined
        self._limit = limit
        # Arguments of the kernel that are the same for all lanes, with their places.
        self._arguments: dict[int, tuple[int, Operand]] = {}

    def within(self, prefix: str) -> "Lowering":
        """A procedure of the same module, whose names begin so."""
        inner = Lowering(
            self.code.width, self.memory.always_copies, self._limit, self.inlined, prefix, self.code.target
        )
        inner.procedures, inner.code.declared = self.procedures, self.code.declared
        inner.memory.constants = self.memory.constants
        return inner

    def run(self, closed: ClosedJaxpr, args: list[Operand]) -> list[Any]:
        """Writes a jaxpr; gives its results."""
        environment = Environment(self, self.inlined(closed), args)
        environment.advance(0, len(environment.jaxpr.eqns))
        return environment.results()

    def argument(self, place: int, aval: Aval) -> Operand:
        """An argument of the kernel that is the same for all lanes."""
        kind, parts = parts_of(aval.dtype)
        buffer = Buffer(f"%arg{place}", kind, False, writable=False, parts=parts)
        view = View(np.dtype(aval.dtype), aval.shape, buffer, row_major(aval.shape))
        x = view if view.size > THRESHOLDS.carried else self.memory.entries(view)
        self._arguments[id(x)] = place, x
        return x

    def place_of(self, x: Operand) -> int:
        """Which argument of the kernel this is; −1 if none."""
        return self._arguments.get(id(x), (-1, x))[0]

    def call(self, closed: ClosedJaxpr, args: list[Operand]) -> list[Any]:
        """Writes a call of a procedure; gives its results."""
        return self.procedures.call(self, closed, args)

    def constant(self, x: ArrayLike) -> Any:
        """Known numbers; many of them are data of the module."""
        x = np.asarray(x)
        if x.size > THRESHOLDS.folded:
            return self.memory.constant_view(x)
        return objects([x[i] for i in np.ndindex(x.shape)], x.shape)

    def equation(self, eqn: Equation, args: list[Operand], into_loop: bool = False) -> list[Any]:
        """Writes an equation; gives its results. `into_loop`: what reads them is a loop over arrays in memory."""
        rule = RULES[eqn.primitive.name]
        try:
            large = rule.nested or self._is_large(rule, eqn, args) or (into_loop and _is_broadcast(rule, eqn))
            args = args if large else list(map(self.memory.entries, args))
            out = rule.lower(Context(self, eqn, large), *args, **eqn.params)
            out = out if isinstance(out, list) else [out]
            _check(eqn, out)
        except (TooLarge, LoweringError):
            raise
        except Exception as error:
            raise LoweringError(f"The rule of `{eqn.primitive.name}` failed at {quoted(eqn)}: {error!r}") from error
        if len(self.code.lines) + len(self.procedures.lines) > self._limit:
            raise TooLarge
        return out

    def _is_large(self, rule: Rule, eqn: Equation, args: list[Operand]) -> bool:
        """Whether an operand is in memory, or the result is so large that it shall be."""
        largest = max((v.aval.size for v in eqn.outvars), default=0)
        if largest > THRESHOLDS.folded or (largest > THRESHOLDS.in_registers and not _stays_known(rule, eqn, args)):
            return True
        return any(not isinstance(a, np.ndarray) and a.size > self.memory.few for a in args)


def _is_broadcast(rule: Rule, eqn: Equation) -> bool:
    """Whether the result has many entries of few operands, as an outer product: a loop reads these through strides."""
    size = eqn.outvars[0].aval.size
    return rule.fuses and size > THRESHOLDS.carried and size >= 2 * sum(v.aval.size for v in eqn.invars)


def _check(eqn: Equation, out: list[Operand]) -> None:
    """What has another shape or type than the equation says would be read and written past its end."""
    for v, x in zip(eqn.outvars, out, strict=True):
        dtype = v.aval.dtype if isinstance(x, np.ndarray) else x.dtype
        if tuple(x.shape) != tuple(v.aval.shape) or dtype != v.aval.dtype:
            raise AssertionError(f"it gave {dtype}{list(x.shape)}")


def _stays_known(rule: Rule, eqn: Equation, args: list[Operand]) -> bool:
    """Whether all operands are numbers, and the results are then too, without an instruction."""
    if not (rule.moves or is_on_numbers(eqn)):
        return False
    return all(isinstance(a, np.ndarray) and are_known(a) for a in args)
