"""Which results of a jaxpr may differ from lane to lane, given which of its inputs do.

What passes through memory counts as different, since memory is kept for each lane.
"""

import weakref
from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from .._compat import scan_counts
from ..jaxprs.walk import called
from ..thresholds import THRESHOLDS
from ..types import Equation, Params
from .registry import RULES


# They are updates at places found at run time, before they are inlined.
_UPDATES = frozenset({"maybe_set"})


# A loop asks for its body at each turn of the search for a fixed point, and a loop within it at each turn of that.
_known: weakref.WeakKeyDictionary[Jaxpr, dict[Any, list[bool]]] = weakref.WeakKeyDictionary()


def varying(jaxpr: ClosedJaxpr | Jaxpr, inputs: Sequence[bool], in_memory: bool = True) -> list[bool]:
    """For each output whether it may; `in_memory`: what passes through memory does in any case."""
    inner: Any = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    known, key = _known.setdefault(inner, {}), (*inputs, in_memory)
    if key not in known:
        known[key] = _varying(inner, inputs, in_memory)
    return known[key]


def _varying(jaxpr: Jaxpr, inputs: Sequence[bool], in_memory: bool) -> list[bool]:
    found: dict[Any, bool] = dict(zip(jaxpr.invars, inputs, strict=True))
    read = lambda v: not isinstance(v, Literal) and found.get(v, False)
    for eqn in jaxpr.eqns:
        found.update(zip(eqn.outvars, results(eqn, list(map(read, eqn.invars)), in_memory), strict=True))
    return list(map(read, jaxpr.outvars))


def results(eqn: Equation, args: list[bool], in_memory: bool = True) -> list[bool]:
    """For each result of an equation whether it may."""
    name, p, n = eqn.primitive.name, eqn.params, len(eqn.outvars)
    inner = p["jaxpr"] if name == "procedure" else called(eqn)
    if inner is not None:
        return varying(inner, args, in_memory)
    if name == "while":
        c, b = p["cond_nconsts"], p["body_nconsts"]
        return varying_in_loop(p, [args[:c], args[c : c + b], args[c + b :]], in_memory)
    if name == "scan":
        c, k = scan_counts(p)
        xs = [in_memory or x for x in args[c + k :]]
        carry = varying_in_scan(p["jaxpr"], [args[:c], args[c : c + k], xs], in_memory)
        ys = varying(p["jaxpr"], [*args[:c], *carry, *xs], in_memory)[k:]
        return [*carry, *(in_memory or y for y in ys)]
    if name == "cond":
        which, *rest = args
        return [which or any(of) for of in zip(*(varying(b, rest, in_memory) for b in p["branches"]), strict=True)]
    large = in_memory and any(getattr(v.aval, "size", 1) > THRESHOLDS.carried for v in (*eqn.invars, *eqn.outvars))
    by_memory = in_memory and (name in _UPDATES or (name in RULES and RULES[name].by_memory))
    return [any(args) or large or by_memory] * n


def varying_in_loop(p: Params, args: list[list[bool]], in_memory: bool = True) -> list[bool]:
    """What a `while` loop carries; all of it if some lanes go on longer than others."""
    of_cond, of_body, carry = args
    while True:
        (goes_on,) = varying(p["cond_jaxpr"], [*of_cond, *carry], in_memory)
        following = varying(p["body_jaxpr"], [*of_body, *carry], in_memory)
        joined = [goes_on or a or b for a, b in zip(carry, following, strict=True)]
        if joined == carry:
            return carry
        carry = joined


def varying_in_scan(jaxpr: ClosedJaxpr, args: list[list[bool]], in_memory: bool = True) -> list[bool]:
    """What a `scan` carries."""
    consts, carry, xs = args
    while True:
        following = varying(jaxpr, [*consts, *carry, *xs], in_memory)[: len(carry)]
        joined = [a or b for a, b in zip(carry, following, strict=True)]
        if joined == carry:
            return carry
        carry = joined
