"""A jaxpr that is being run."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Var

from ..thresholds import THRESHOLDS
from ..types import Atom, aval_of
from .arrays import Fused, Operand, View
from .context import Lowering
from .operands import retain
from .registry import RULES


class Environment:
    """How far it has been run, and the values that are still needed."""

    def __init__(self, lowering: Lowering, closed: ClosedJaxpr, args: list[Operand]) -> None:
        self.lowering, self.jaxpr = lowering, closed.jaxpr
        self.values: dict[Any, Any] = {}
        self._let_go: dict[Any, None] = {}
        self._last: dict[Any, int] = {}
        read = [v for eqn in self.jaxpr.eqns for v in eqn.invars] + self.jaxpr.outvars
        self._uses = Counter(v for v in read if isinstance(v, Var))
        for i, eqn in enumerate(self.jaxpr.eqns):
            self._last.update((v, i) for v in eqn.invars if isinstance(v, Var))
        self._last.update((v, len(self.jaxpr.eqns)) for v in self.jaxpr.outvars if isinstance(v, Var))
        self._bind(self.jaxpr.invars, args, -1)
        self._bind(self.jaxpr.constvars, list(map(lowering.constant, closed.consts)), -1)

    def _bind(self, variables: Sequence[Any], values: Sequence[Operand], now: int) -> None:
        for v, x in zip(variables, values, strict=True):
            if self._last.get(v, -1) > now:
                x = (
                    self.lowering.memory.materialised(x)
                    if self._uses[v] > 1 or getattr(x, "depth", 0) > THRESHOLDS.fused_depth
                    else x
                )
                self.values[v] = x
                retain(x, 1)

    def _read(self, v: Atom) -> Any:
        return self.lowering.constant(np.asarray(v.val, aval_of(v).dtype)) if isinstance(v, Literal) else self.values[v]

    def operands(self, i: int) -> list[Any]:
        """The operands of equation i; those that nothing else needs are let go."""
        found = [self._read(v) for v in self.jaxpr.eqns[i].invars]
        for v in dict.fromkeys(v for v in self.jaxpr.eqns[i].invars if isinstance(v, Var) and self._last[v] == i):
            x = self.values.pop(v)
            retain(x, -1)
            self._let_go.update(dict.fromkeys(getattr(x, "buffers", ())))
        return found

    def give(self, i: int, values: Sequence[Operand]) -> None:
        """The results of equation i."""
        self._bind(self.jaxpr.eqns[i].outvars, values, i)
        self.lowering.memory.recycle(self._let_go)
        self._let_go.clear()

    def advance(self, start: int, stop: int) -> None:
        """Runs the equations from `start` to `stop`."""
        for i in range(start, stop):
            self.give(i, self.lowering.equation(self.jaxpr.eqns[i], self.operands(i), self._goes_into_loop(i)))

    def _goes_into_loop(self, i: int) -> bool:
        """Whether equation i is read once, by an operation that goes through as many entries of an array in memory."""
        result = self.jaxpr.eqns[i].outvars[0]
        place = self._last.get(result, 0)
        if self._uses[result] != 1 or place >= len(self.jaxpr.eqns):
            return False
        reader, few = self.jaxpr.eqns[place], self.lowering.memory.few
        others = (self.values.get(v) for v in reader.invars if isinstance(v, Var))
        return (
            RULES[reader.primitive.name].fuses
            and aval_of(reader.outvars[0]).shape == aval_of(result).shape
            and any(isinstance(x, View | Fused) and x.size > few for x in others)
        )

    def results(self) -> list[Any]:
        """What the jaxpr returns, when all of it has been run."""
        out = [self._read(v) for v in self.jaxpr.outvars]
        for x in self.values.values():
            retain(x, -1)
        return out
