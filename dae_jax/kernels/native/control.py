"""Jaxprs, run equation by equation."""

from typing import Any

import jax
from jax.extend.core import ClosedJaxpr

from ..entries import NotEntryByEntry
from .branches import Branches
from .frame import Frame
from .primitives import CALLS, SIMPLE


# Primitives of equinox that mean something to transformations only, and those that are more than that.
_TRANSPARENT = frozenset({"nonbatchable", "nontraceable", "nondifferentiable_backward", "unvmap_max"})
_OF_EQUINOX = frozenset({"select_if_vmap", "unvmap_any", "unvmap_all", "maybe_set"})
KNOWN = _TRANSPARENT | _OF_EQUINOX | CALLS.keys() | SIMPLE | {"while", "cond", "scan"}


class Control(Branches):
    """Runs jaxprs with control flow."""

    def run(self, closed: ClosedJaxpr, args: list[Any]) -> list[Any]:
        frame = Frame(self, closed, args)
        frame.advance(0, len(frame.jaxpr.eqns))
        return frame.results()

    def equation(self, eqn: Any, args: list[Any]) -> list[Any]:
        name, p = eqn.primitive.name, eqn.params
        if eqn.effects:
            raise NotEntryByEntry(name)
        if name in CALLS:
            return self.run(called_by(eqn), args)
        if name in _TRANSPARENT:
            return args[:1]
        match name:
            case "while":
                return self._while(p, args)
            case "cond":
                return self._cond(eqn, args)
            case "scan":
                return self._scan(eqn, args)
            case "select_if_vmap":
                return [args[1]]
            case "unvmap_any" | "unvmap_all" if not args[0].ndim:
                return [args[0]]
            case "maybe_set" | "unvmap_any" | "unvmap_all":
                return self.run(_meaning(eqn), args)
        return super().equation(eqn, args)


def called_by(eqn: Any) -> ClosedJaxpr:
    """What a call runs."""
    inner = eqn.params[CALLS[eqn.primitive.name]]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def _meaning(eqn: Any) -> ClosedJaxpr:
    """A primitive of equinox by others."""
    structs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
    return jax.make_jaxpr(lambda *xs: eqn.primitive.impl(*xs, **eqn.params))(*structs)
