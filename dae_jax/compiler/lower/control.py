"""Jaxprs, run equation by equation."""

from typing import Any

from jax.extend.core import ClosedJaxpr

from ..jaxprs.inline import KNOWN as OF_FLAT
from ..jaxprs.scalar_interpreter import Unsupported
from .branches import Branches
from .environment import Environment
from .primitives import SIMPLE


KNOWN = OF_FLAT | SIMPLE | {"while", "cond", "scan"}


class Control(Branches):
    """Runs jaxprs with control flow."""

    def run(self, closed: ClosedJaxpr, args: list[Any]) -> list[Any]:
        frame = Environment(self, self.flat(closed), args)
        frame.advance(0, len(frame.jaxpr.eqns))
        return frame.results()

    def equation(self, eqn: Any, args: list[Any]) -> list[Any]:
        if eqn.effects:
            raise Unsupported(eqn.primitive.name)
        if eqn.primitive.name in ("while", "scan", "cond"):
            args = list(map(self.code.materialised, args))
        match eqn.primitive.name:
            case "while":
                return self._while(eqn.params, args)
            case "cond":
                return self._cond(eqn, args)
            case "scan":
                return self._scan(eqn, args)
        return super().equation(eqn, args)
