"""Loops of a few turns that a counter counts: how many is known but for where the counter starts, such as diffrax's over the stages
of a Runge-Kutta step, which leaves the first one out where the last step has computed it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from ..thresholds import THRESHOLDS
from ..types import Atom, Aval, Equation, Params, aval_of
from .walk import numbers_computed


class Range(NamedTuple):
    """The integers, or truth values, from the least to the greatest that something may be."""

    least: int
    greatest: int


# What makes a variable, if anything does.
Made = Callable[[Any], Equation | None]
# Selections within selections that are looked through.
DEPTH = 4
ALWAYS, NEVER, SOMETIMES = Range(1, 1), Range(0, 0), Range(0, 1)


def written_out(
    eqn: Equation, args: list[Atom], made: Made, inlined: Callable[[ClosedJaxpr], ClosedJaxpr]
) -> ClosedJaxpr | None:
    """A `while` as a function of its operands, its turns one after another; `None` where they are not few, or not known.

    **Arguments**

    - `args`: the operands; `made` gives the equation that makes one.
    - `inlined`: gives a jaxpr without calls.
    """
    p = eqn.params
    n, m = p["cond_nconsts"], p["body_nconsts"]
    carry = args[n + m :]
    starts = [_range(x, made) for x in carry]
    narrow = {k: r for k, (x, r) in enumerate(zip(carry, starts, strict=True)) if r and _is_start(aval_of(x), r)}
    if not narrow:
        return None
    condition, body = inlined(p["cond_jaxpr"]), inlined(p["body_jaxpr"])
    counters, limit = _counters(body, m), THRESHOLDS.turns_written_out // (1 + numbers_computed(body))
    counted = [r if k in counters else None for k, r in enumerate(starts)]
    for main in filter(counters.__contains__, narrow):
        first = narrow[main]
        last = _last(condition, n, counted, main, first, limit)
        if last is not None:
            return _turns(p, first, main, last, list(map(aval_of, args)))
    return None


def _is_start(aval: Aval, r: Range) -> bool:
    """Whether a counter may begin here: at one of two numbers, and without an overflow later."""
    largest = r.greatest + THRESHOLDS.turns_written_out
    return aval.dtype.kind == "i" and r.greatest - r.least <= 1 and largest < np.iinfo(aval.dtype).max


def _range(x: Atom, made: Made, depth: int = DEPTH) -> Range | None:
    aval = aval_of(x)
    if aval.shape or aval.dtype.kind not in "ib" or not depth:
        return None
    if isinstance(x, Literal):
        return Range(int(x.val), int(x.val))
    eqn = made(x)
    chosen = () if eqn is None else eqn.invars[1:] if eqn.primitive.name == "select_n" else ()
    of = [_range(v, made, depth - 1) for v in chosen]
    known = [r for r in of if r is not None]
    if known and len(known) == len(of):
        return Range(min(r.least for r in known), max(r.greatest for r in known))
    return SOMETIMES if aval.dtype.kind == "b" else None


def _counters(body: ClosedJaxpr, consts: int) -> frozenset[int]:
    """The places of the carry to which each turn adds 1."""
    made = {v: eqn for eqn in body.jaxpr.eqns for v in eqn.outvars}

    def is_counter(before: Any, after: Any) -> bool:
        eqn = None if isinstance(after, Literal) else made.get(after)
        if eqn is None or eqn.primitive.name != "add":
            return False
        ones = [v for v in eqn.invars if isinstance(v, Literal) and v.val == 1]
        return bool(ones) and any(v is before for v in eqn.invars)

    pairs = enumerate(zip(body.jaxpr.invars[consts:], body.jaxpr.outvars, strict=True))
    return frozenset(k for k, (before, after) in pairs if is_counter(before, after))


def _last(
    condition: ClosedJaxpr, consts: int, counted: list[Range | None], main: int, first: Range, limit: int
) -> int | None:
    """The value of the main counter at which the loop ends, in every case, where all smaller ones are turns; `counted`: where each
    counter starts.
    """
    for now in range(first.least, first.least + limit + 1):
        # So many turns have been done.
        fewest, most = max(now - first.greatest, 0), now - first.least
        carry = [r and Range(r.least + fewest, r.greatest + most) for r in counted]
        carry[main] = Range(now, now)
        goes_on = _value(condition, [*[None] * consts, *carry])
        if goes_on != ALWAYS:
            return now if goes_on == NEVER and now >= first.greatest else None
    return None


def _value(condition: ClosedJaxpr, args: list[Range | None]) -> Range:
    """Whether a condition holds."""
    found: dict[Any, Range | None] = dict(zip(condition.jaxpr.invars, args, strict=True))
    read = lambda v: _range(v, lambda _: None) if isinstance(v, Literal) else found.get(v)
    for eqn in condition.jaxpr.eqns:
        found[eqn.outvars[0]] = _result(eqn, list(map(read, eqn.invars)))
    return read(condition.jaxpr.outvars[0]) or SOMETIMES


def _result(eqn: Equation, x: list[Any]) -> Range | None:
    name, is_truth = eqn.primitive.name, aval_of(eqn.outvars[0]).dtype.kind == "b"
    if name == "and" and is_truth:
        a, b = (r or SOMETIMES for r in x)
        return Range(min(a.least, b.least), min(a.greatest, b.greatest))
    if None in x or name not in ("lt", "le", "gt", "ge"):
        return None
    a, b = x if name in ("lt", "le") else x[::-1]
    by = 0 if name in ("le", "ge") else 1
    return Range(int(a.greatest + by <= b.least), int(a.least + by <= b.greatest))


def _turns(p: Params, first: Range, main: int, last: int, avals: list[Aval]) -> ClosedJaxpr:
    body, consts = jaxpr_as_fun(p["body_jaxpr"]), p["cond_nconsts"]

    def loop(*xs: Array) -> list[Any]:
        m = consts + p["body_nconsts"]
        fixed, carry = xs[consts:m], list(xs[m:])
        start = carry[main]
        for now in range(first.least, last):

            def turn(carry: list[Any], now: int = now) -> list[Any]:
                return body(*fixed, *carry[:main], jnp.asarray(now, start.dtype), *carry[main + 1 :])

            carry = list(jax.lax.cond(start <= now, turn, list, carry) if now < first.greatest else turn(carry))
        carry[main] = jnp.asarray(last, start.dtype)
        return carry

    return jax.make_jaxpr(loop)(*(jax.ShapeDtypeStruct(a.shape, np.dtype(a.dtype)) for a in avals))
