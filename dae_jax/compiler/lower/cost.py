"""About how many instructions a function takes, before they are written."""

from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ..jaxprs.inline import CALLS, of_solve
from ..jaxprs.scalar_interpreter import STRUCTURAL
from .arrays import SMALL
from .in_memory import LARGE


# A loop over an array takes about as many as a few entries do.
LOOP = 12
# What moves entries takes none where these are in registers.
_MOVES = STRUCTURAL - {"add_any", "dot_general", "reduce_max", "reduce_sum"} | {"unstack"}


def extent(jaxpr: ClosedJaxpr | Jaxpr, in_memory: Sequence[bool]) -> tuple[int, list[bool]]:
    """The number, and which of the results are in memory; `in_memory`: which of the arguments are."""
    jaxpr = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    found: dict[Any, bool] = dict(zip(jaxpr.invars, in_memory, strict=True))
    read = lambda v: not isinstance(v, Literal) and found.get(v, False)
    total = 0
    for eqn in jaxpr.eqns:
        count, outs = _of_equation(eqn, list(map(read, eqn.invars)))
        total += count
        found.update(zip(eqn.outvars, outs, strict=True))
    return total, list(map(read, jaxpr.outvars))


def _of_equation(eqn: Any, args: list[bool]) -> tuple[int, list[bool]]:
    name, p = eqn.primitive.name, eqn.params
    sizes = [getattr(v.aval, "size", 1) for v in eqn.outvars]
    kept = [size > SMALL for size in sizes]
    if name in CALLS:
        return extent(p[CALLS[name]], args)
    if name == "custom_linear_solve":
        return extent(p["jaxprs"].solve, of_solve(p, args))
    if name == "while":
        c, b = p["cond_nconsts"], p["body_nconsts"]
        return extent(p["cond_jaxpr"], args[:c] + kept)[0] + extent(p["body_jaxpr"], args[c : c + b] + kept)[0], kept
    if name == "scan":
        rows = [v.aval.size > SMALL for v in p["jaxpr"].jaxpr.invars[p["num_consts"] :]]
        return extent(p["jaxpr"], args[: p["num_consts"]] + rows)[0], kept
    if name == "cond":
        found = [extent(branch, args[1:]) for branch in p["branches"]]
        return sum(count for count, _ in found), kept
    by_loops = any(args) or max(sizes, default=0) > LARGE
    if name in _MOVES and not by_loops:
        return 0, kept
    return sum(min(size, LOOP) if by_loops else size for size in sizes), [by_loops and large for large in kept]
