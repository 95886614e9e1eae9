"""Whether a function can be compiled, and to what: found before an instruction is written, by the only judge."""

import dataclasses
import functools
from collections.abc import Iterator

from jax.core import Tracer
from jax.extend.core import ClosedJaxpr

from .._compat import low
from ..emit import available
from ..emit.target import Target, host
from ..jaxprs.equal_functions import EqualFunctions
from ..jaxprs.inline import Inlining
from ..jaxprs.random_keys import without_keys
from ..jaxprs.scalar_interpreter import Unsupported
from ..jaxprs.walk import closed_in, equations
from ..thresholds import THRESHOLDS
from ..types import Equation
from . import estimate, rules as rules
from .annotated import Annotated
from .dtypes import ALL
from .lowering import TooLarge
from .module_text import module_text
from .registry import RULES, named, quoted
from .repeated import is_large, repeated


def annotate(
    jaxpr: ClosedJaxpr, batched: tuple[bool, ...] = (), target: Target | None = None
) -> Annotated | Unsupported:
    """The function as it will be compiled, or why it cannot be; `batched`: which arguments have a leading axis of lanes;
    `target`: the machine, this one if it is not given.
    """
    if target is None and not available():
        return Unsupported("no machine code is made for this operating system", primitive="system")
    return _annotated(jaxpr, batched, target or host())


def unsupported(
    jaxpr: ClosedJaxpr, batched: tuple[bool, ...] = (), target: Target | None = None
) -> tuple[Unsupported, ...]:
    """All that keeps a function from being compiled; empty if nothing does."""
    judged, inlined = annotate(jaxpr, batched, target), Inlining()
    if isinstance(judged, Annotated):
        return ()
    if judged.primitive == "size":
        return (judged,)
    return tuple(_unsupported(inlined(without_keys(low(jaxpr))), inlined, target)) or (judged,)


@functools.lru_cache(maxsize=8)
def _annotated(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], target: Target) -> Annotated | Unsupported:
    whole, procedures = without_keys(low(jaxpr)), frozenset()
    refused = _callback(whole, target)
    if refused is not None:
        return refused
    if not target.threads and is_large(whole):
        whole = EqualFunctions()(whole)
        procedures = repeated(whole)
    inlined = Inlining(procedures)
    found = next(_unsupported(inlined(whole), inlined, target), None)
    return found or _unless_too_large(estimate.annotated(inlined(whole), batched, inlined, target))


def _callback(jaxpr: ClosedJaxpr, target: Target) -> Unsupported | None:
    """A function of the user's, or one that raises, which is not compiled: found before a program, which may be large, is looked into."""
    for eqn in equations(jaxpr):
        if eqn.primitive.name == "pure_callback":
            reason = _reason(eqn, target)
            if reason:
                return Unsupported(reason, quoted(eqn), eqn.primitive.name)
    return None


def _unsupported(jaxpr: ClosedJaxpr, inlined: Inlining, target: Target | None) -> Iterator[Unsupported]:
    for v in (*jaxpr.jaxpr.invars, *jaxpr.jaxpr.outvars):
        if named(v.aval) not in ALL:
            yield Unsupported(
                f"{named(v.aval)} is no type of number that is compiled", primitive="convert_element_type"
            )
    yield from _unsupported_within(jaxpr, inlined, target)


def _unsupported_within(jaxpr: ClosedJaxpr, inlined: Inlining, target: Target | None) -> Iterator[Unsupported]:
    if any(isinstance(x, Tracer) for x in jaxpr.consts):
        yield Unsupported("a constant is being traced", primitive="constant")
    for eqn in jaxpr.jaxpr.eqns:
        reason = _reason(eqn, target)
        if reason:
            yield Unsupported(reason, quoted(eqn), eqn.primitive.name)
        elif RULES[eqn.primitive.name].nested:
            for body in closed_in(eqn):
                yield from _unsupported_within(inlined(body), inlined, target)


def _reason(eqn: Equation, target: Target | None) -> str | None:
    name = eqn.primitive.name
    if eqn.effects:
        return f"`{name}` has side effects"
    if name not in RULES:
        return f"`{name}` has no rule"
    if RULES[name].on_host and target is not None and target.threads:
        return f"`{name}` runs on the host"
    return RULES[name].unsupported(eqn)


def _unless_too_large(annotated: Annotated) -> Annotated | Unsupported:
    """The function, or why it is too large. Where the estimates do not settle it, it is written to see."""
    cost, limit = annotated.cost, THRESHOLDS.instructions
    reason = f"it takes more than {limit} instructions, or {THRESHOLDS.heap_bytes} bytes, which is slow to compile"
    refused = Unsupported(reason, primitive="size")
    if cost > THRESHOLDS.overestimate * limit:
        return refused
    # With arrays that are copied, and those of loops and branches.
    if cost <= limit and 3 * annotated.bytes * annotated.width <= THRESHOLDS.heap_bytes:
        return annotated
    try:
        return dataclasses.replace(annotated, text=module_text(annotated, limit=limit))
    except TooLarge:
        return refused
