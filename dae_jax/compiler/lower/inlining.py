"""The jaxprs in a function without their calls, each inlined once."""

from collections.abc import Hashable, Iterator

from jax.extend.core import ClosedJaxpr

from ..jaxprs.inline import inlined
from ..jaxprs.walk import jaxprs_in
from ..types import Equation


class Inlining:
    """Jaxprs without calls but those of procedures, by the jaxprs that they come from."""

    def __init__(self, procedures: frozenset[Hashable] = frozenset()) -> None:
        self._procedures = procedures
        self._known: dict[int, tuple[ClosedJaxpr, ClosedJaxpr]] = {}

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        if id(closed) not in self._known:
            self._known[id(closed)] = closed, inlined(closed, self._procedures)
        return self._known[id(closed)][1]


def inner(eqn: Equation) -> Iterator[ClosedJaxpr]:
    """The jaxprs that a loop or a branch runs."""
    return (x for x in jaxprs_in(tuple(eqn.params.values())) if isinstance(x, ClosedJaxpr))
