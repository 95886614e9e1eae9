"""Rules of loops. With lanes a loop runs until the last lane is done, and a mask says which lanes take part."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from ..._compat import scan_counts
from ...jaxprs.objects import objects
from ...thresholds import THRESHOLDS
from ..arrays import Operand, View
from ..blocks import loop
from ..carry import Carry
from ..context import Context
from ..dtypes import ALL
from ..estimate import is_written_out
from ..operands import has_lanes, retain
from ..registry import free, rule
from ..uniformity import varying_in_loop, varying_in_scan
from ..values import Value


@contextlib.contextmanager
def _retained(xs: Sequence[Operand]) -> Iterator[None]:
    """Something reads these arrays later."""
    for x in xs:
        retain(x, 1)
    yield
    for x in xs:
        retain(x, -1)


def _lanes(xs: Sequence[Operand]) -> list[bool]:
    return list(map(has_lanes, xs))


@rule("while", ALL, cost=free, nested=True)
def while_(context: Context, *args: Operand, **p: Any) -> list[Any]:
    """Turns for as long as a condition holds; with lanes, in any of them."""
    code, n, m = context.code, p["cond_nconsts"], p["body_nconsts"]
    operands = list(map(context.memory.materialised, args))
    of_cond, of_body, first = operands[:n], operands[n : n + m], operands[n + m :]
    with _retained([*of_cond, *of_body]):
        own = varying_in_loop(p, list(map(_lanes, (of_cond, of_body, first)))) if code.width > 1 else ()
        avals = [v.aval for v in p["body_jaxpr"].jaxpr.invars[m:]]
        head, body, after, active = (code.name() for _ in range(4))
        carry = Carry(context.memory, avals, first, own)
        entered, mask = code.block, code.mask
        everyone = code.text(mask, "i1", True) if mask else "splat (i1 true)"
        code.jump(head)
        code.label(head)
        here = len(code.lines)
        with code.scope():
            with _retained(carry.values):
                (goes_on,) = context.run(p["cond_jaxpr"], [*of_cond, *carry.values])
            more = code.copy(context.memory.number(goes_on), "i1")
            each = any(own) and more.lanes
            if each:
                code.mask = code.op("and", "i1", more, Value(f"%{active}", "i1", True))
                more = code.any(code.mask)
            running = code.mask if each else None
            code.branch(more, body, after)
            code.label(body)
            phis = carry.turn(context.run(p["body_jaxpr"], [*of_body, *carry.values]), entered, running)
            if running:
                kind = code.type("i1", True)
                phis.append(f"%{active} = phi {kind} [ {everyone}, %{entered} ], [ {running.name}, %{code.block} ]")
            code.lines[here:here] = phis
            code.jump(head)
        code.label(after)
        code.mask = mask
    return carry.values


@rule("scan", ALL, cost=free, nested=True)
def scan(context: Context, *args: Operand, jaxpr: ClosedJaxpr, **p: Any) -> list[Any]:
    """A known number of turns, written out where they are few."""
    memory, (count, carried) = context.memory, scan_counts(p)
    start, operands = count + carried, list(map(memory.materialised, args))
    consts, first, xs = operands[:count], operands[count:start], operands[start:]
    if is_written_out(context.eqn):
        with _retained(consts):
            return _written_out(context, jaxpr, consts, first, list(map(memory.entries, xs)))
    rows = [memory.view(x, dtype) for x, dtype in zip(xs, context.dtypes[start:], strict=True)]
    with _retained([*consts, *rows]):
        return _scanned(context, jaxpr, consts, first, rows)


def _scanned(
    context: Context, inner: ClosedJaxpr, consts: list[Operand], first: list[Operand], rows: Sequence[View]
) -> list[Any]:
    code, memory, p = context.code, context.memory, context.eqn.params
    n, m = scan_counts(p)
    ys = [memory.new(a.dtype, a.shape) for a in context.outs[m:]]
    own = varying_in_scan(inner, [_lanes(consts), _lanes(first), [True] * len(rows)]) if code.width > 1 else ()
    carry = Carry(memory, [v.aval for v in inner.jaxpr.invars[n : n + m]], first, own)
    entered, phis = code.block, []
    with loop(code, p["length"], phis) as i:
        at = code.op("sub", "i64", p["length"] - 1, i) if p["reverse"] else i
        now = [memory.row(x, at) for x in rows]
        now = [x if x.size > THRESHOLDS.carried else memory.entries(x) for x in now]
        out = context.run(inner, [*consts, *carry.values, *now])
        for y, value in zip(ys, out[m:], strict=True):
            memory.assign(memory.row(y, at), value, fresh=True)
        phis += carry.turn(out[:m], entered, None)
    return [*carry.values, *ys]


def _written_out(
    context: Context, inner: ClosedJaxpr, consts: list[Operand], carry: list[Operand], xs: list[np.ndarray]
) -> list[Any]:
    length, m = context.eqn.params["length"], len(carry)
    rows: list[Any] = [None] * length
    for i in reversed(range(length)) if context.eqn.params["reverse"] else range(length):
        now = [objects(list(x[i].ravel()) if x.ndim > 1 else [x[i]], x.shape[1:]) for x in xs]
        out = context.run(inner, [*consts, *carry, *now])
        carry, rows[i] = out[:m], list(map(context.memory.entries, out[m:]))
    ys = [objects([e for row in rows for e in row[k].ravel()], a.shape) for k, a in enumerate(context.outs[m:])]
    return [*carry, *ys]
