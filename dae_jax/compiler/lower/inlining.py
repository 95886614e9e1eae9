"""The jaxprs in a function without their calls, each inlined once."""

from collections.abc import Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr

from ..jaxprs.inline import inlined


class Inlining:
    """Jaxprs without calls, by the jaxprs that they come from."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[ClosedJaxpr, ClosedJaxpr]] = {}

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        if id(closed) not in self._known:
            self._known[id(closed)] = closed, inlined(closed)
        return self._known[id(closed)][1]


def inner(eqn: Any) -> Iterator[ClosedJaxpr]:
    """The jaxprs that a loop or a branch runs."""
    is_jaxpr = lambda x: isinstance(x, ClosedJaxpr)
    return filter(is_jaxpr, jax.tree.leaves(tuple(eqn.params.values()), is_leaf=is_jaxpr))
