"""The jaxprs in a function without their calls, each inlined once."""

from collections.abc import Iterator

from jax.extend.core import ClosedJaxpr

from ..jaxprs.inline import inlined
from ..jaxprs.walk import jaxprs_in
from ..types import Equation


class Inlining:
    """Jaxprs without calls, by the jaxprs that they come from."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[ClosedJaxpr, ClosedJaxpr]] = {}

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        if id(closed) not in self._known:
            self._known[id(closed)] = closed, inlined(closed)
        return self._known[id(closed)][1]


def inner(eqn: Equation) -> Iterator[ClosedJaxpr]:
    """The jaxprs that a loop or a branch runs."""
    return (x for x in jaxprs_in(tuple(eqn.params.values())) if isinstance(x, ClosedJaxpr))
