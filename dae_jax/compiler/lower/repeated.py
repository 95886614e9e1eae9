"""Which functions of a large program become procedures: those that are called at several places, and are large."""

from collections import Counter
from collections.abc import Hashable, Iterator

from jax.extend.core import ClosedJaxpr

from ..jaxprs.walk import called, closed_in, identity
from ..thresholds import THRESHOLDS
from ..types import Equation
from .registry import RULES


def is_large(closed: ClosedJaxpr) -> bool:
    """Whether functions of a program become procedures; as a part of its surroundings a function is faster by a fifth."""
    return _visit(closed, {})[1] > THRESHOLDS.whole


def repeated(closed: ClosedJaxpr) -> frozenset[Hashable]:
    """The identities of these functions."""
    functions: dict[Hashable, tuple[int, Counter[tuple[Hashable, bool]]]] = {}
    _visit(closed, functions)
    places, found = Counter({identity(closed): 1}), set()
    # Who calls comes after what it calls.
    for function, (size, held) in reversed(functions.items()):
        count = places[function]
        if size >= THRESHOLDS.procedure and count > 1:
            found.add(function)
            count = 1
        for (inner, _), times in held.items():
            places[inner] += count * times
    return frozenset(found & {inner for _, held in functions.values() for inner, is_call in held if is_call})


def _visit(
    closed: ClosedJaxpr, functions: dict[Hashable, tuple[int, Counter[tuple[Hashable, bool]]]]
) -> tuple[Hashable, int]:
    """Notes down the size of a function, and what it calls and runs; what it calls before it."""
    function = identity(closed)
    if function not in functions:
        size, held = 0, Counter()
        for eqn in closed.jaxpr.eqns:
            for inner, is_call in _held(eqn):
                of_inner, size_of_inner = _visit(inner, functions)
                held[of_inner, is_call] += 1
                size += size_of_inner
            size += _size(eqn)
        functions[function] = size, held
    return function, functions[function][0]


def _held(eqn: Equation) -> Iterator[tuple[ClosedJaxpr, bool]]:
    """The jaxprs that an equation runs, and whether it calls them."""
    inner = called(eqn)
    if inner is not None:
        yield inner, True
    elif eqn.primitive.name == "custom_linear_solve":
        yield eqn.params["jaxprs"].solve, False
    else:
        yield from ((x, False) for x in closed_in(eqn))


def _size(eqn: Equation) -> int:
    """About how many instructions an equation takes that runs nothing."""
    rule = RULES.get(eqn.primitive.name)
    if rule is None or rule.moves or rule.nested:
        return 0
    return sum(min(v.aval.size, THRESHOLDS.loop_cost) for v in eqn.outvars if hasattr(v.aval, "size"))
