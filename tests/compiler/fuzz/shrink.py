"""The smallest part of a program that our compiler still computes otherwise than XLA."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr

from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import compiled

from .check import Difference, arguments, by_xla
from .compare import difference


LINES = 10
# Of numbers that are found on the way.
_ULPS = 256


@dataclasses.dataclass(frozen=True)
class Failure:
    """A function with arguments (`shared`: without a leading axis) of which one result differs."""

    jaxpr: ClosedJaxpr
    args: list[np.ndarray]
    shared: list[bool]
    ulps: float
    scale: float
    copies: bool
    what: str = ""

    def run(self) -> "Failure | None":
        """This with what differs, nothing if it does not."""
        fn, lanes = jaxpr_as_fun(self.jaxpr), tuple(not s for s in self.shared)
        try:
            (found,) = jax.jit(compiled(self.jaxpr, lanes if any(lanes) else (), self.copies))(*self.args)
            (wanted,) = by_xla(fn, self.args, self.shared) if any(lanes) else jax.jit(fn)(*self.args)
        except (Unsupported, TypeError, ValueError):
            return None
        at = difference(found, wanted, self.ulps, self.scale)
        if at is None:
            return None
        batch = f"a batch of {len(np.asarray(found))}" if any(lanes) else "alone"
        return dataclasses.replace(
            self, what=f"{batch}, at {at}: {np.asarray(found)[at]!r}, XLA: {np.asarray(wanted)[at]!r}"
        )

    def __str__(self) -> str:
        text = str(self.jaxpr).splitlines()
        with np.printoptions(threshold=8, edgeitems=3, linewidth=10_000):
            values = [f"{x.dtype}{list(x.shape)} {x!s}".replace("\n", " ")[:150] for x in self.args]
        text += [f"of {'; '.join(values)}"[:400], self.what]
        return "\n".join(text if len(text) <= LINES else [*text[: LINES - 3], "…", *text[-2:]])


def shrunk(found: Difference) -> Failure | None:
    """The smallest failure that is found by leaving out; nothing where the program fails only together with others."""
    program = found.program
    args = arguments(program)
    first = [x if s else x[0] for x, s in zip(args, program.shared, strict=True)]
    jaxpr = jax.make_jaxpr(program.fn)(*first)
    start = Failure(
        _giving(jaxpr, jaxpr.jaxpr.outvars[found.result]),
        args,
        list(program.shared),
        program.ulps,
        program.scale,
        False,
    )
    candidates = [dataclasses.replace(s, copies=c) for c in (False, True) for s in _batches(start, found)]
    now = next(filter(None, (c.run() for c in candidates)), None)
    smaller = now
    while smaller is not None:
        now = smaller
        smaller = next(filter(None, (c.run() for c in _smaller(now))), None)
    return now


def _batches(failure: Failure, found: Difference) -> Iterator[Failure]:
    """Alone, then in ever larger batches."""
    element = found.at[0] if found.batch is not None else 0
    args, shared = failure.args, failure.shared
    row = lambda x, s: x if s else x[element]
    yield dataclasses.replace(
        failure, args=[row(*xs) for xs in zip(args, shared, strict=True)], shared=[True] * len(args)
    )
    for n in sorted({1, found.batch or 1}):
        if not all(shared):
            part = [
                x if s else x[element : element + 1] if n == 1 else x[:n] for x, s in zip(args, shared, strict=True)
            ]
            yield dataclasses.replace(failure, args=part)


def _giving(jaxpr: ClosedJaxpr, v: Any) -> ClosedJaxpr:
    return ClosedJaxpr(jaxpr.jaxpr.replace(outvars=[v], debug_info=_unnamed(jaxpr)), jaxpr.consts)


def _unnamed(jaxpr: ClosedJaxpr) -> Any:
    return jaxpr.jaxpr.debug_info._replace(arg_names=None, result_paths=None)


def _smaller(f: Failure) -> Iterator[Failure]:
    yield from _without_unused(f)
    eqns = f.jaxpr.jaxpr.eqns
    for v in itertools.chain.from_iterable(e.outvars for e in eqns):
        if type(v) is Var and v is not f.jaxpr.jaxpr.outvars[0] and v.aval.dtype != jax.dtypes.float0 and v.aval.size:
            yield dataclasses.replace(f, jaxpr=_giving(f.jaxpr, v), ulps=max(f.ulps, _ULPS), scale=_ULPS)
    for first in (len(eqns) - 1, *range(1, len(eqns))):
        if first > 0:
            yield _from(f, first)
    for k, eqn in enumerate(eqns):
        for inner, pick in _inner(eqn):
            yield from _unwrapped(f, k, inner, pick)


def _without_unused(f: Failure) -> Iterator[Failure]:
    jaxpr, used = dce_jaxpr(f.jaxpr.jaxpr, [True])
    read = {id(v) for e in jaxpr.eqns for v in e.invars} | {id(v) for v in jaxpr.outvars}
    consts = [(v, x) for v, x in zip(jaxpr.constvars, f.jaxpr.consts, strict=True) if id(v) in read]
    jaxpr = jaxpr.replace(constvars=[v for v, _ in consts])
    fewer = len(jaxpr.eqns) < len(f.jaxpr.jaxpr.eqns) or len(consts) < len(f.jaxpr.consts)
    if any(used) and (fewer or not all(used)):
        keep = lambda xs: [x for x, u in zip(xs, used, strict=True) if u]
        found = ClosedJaxpr(jaxpr, [x for _, x in consts])
        yield dataclasses.replace(f, jaxpr=found, args=keep(f.args), shared=keep(f.shared))


def _values(f: Failure, variables: Sequence[Any]) -> tuple[list[np.ndarray], list[bool]]:
    """What variables are by XLA, and whether in all elements the same."""
    jaxpr = f.jaxpr.jaxpr.replace(outvars=list(variables), debug_info=_unnamed(f.jaxpr))
    fn = jaxpr_as_fun(ClosedJaxpr(jaxpr, f.jaxpr.consts))
    alone = all(f.shared)
    found = jax.jit(fn)(*f.args) if alone else by_xla(fn, f.args, f.shared)
    return list(map(np.asarray, found)), [alone] * len(found)


def _from(f: Failure, first: int) -> Failure:
    """Without the equations before the given one: what these find becomes arguments."""
    jaxpr = f.jaxpr.jaxpr
    here = {v for e in jaxpr.eqns[:first] for v in e.outvars}
    read = [v for e in jaxpr.eqns[first:] for v in e.invars] + jaxpr.outvars
    new = list(dict.fromkeys(v for v in read if not isinstance(v, Literal) and v in here))
    values, shared = _values(f, new)
    rest = jaxpr.replace(invars=[*jaxpr.invars, *new], eqns=jaxpr.eqns[first:], debug_info=_unnamed(f.jaxpr))
    return dataclasses.replace(
        f, jaxpr=ClosedJaxpr(rest, f.jaxpr.consts), args=[*f.args, *values], shared=[*f.shared, *shared]
    )


def _inner(eqn: Any) -> Iterator[tuple[ClosedJaxpr, Any]]:
    """The functions that an equation runs, and which of its operands these take, a row of some."""
    p, name = eqn.params, eqn.primitive.name
    if name == "cond":
        yield from ((b, [(i, False) for i in range(1, len(eqn.invars))]) for b in p["branches"])
    elif name == "scan":
        rows = p["num_consts"] + p["num_carry"]
        yield p["jaxpr"], [(i, i >= rows) for i in range(len(eqn.invars))]
    elif name == "while":
        yield p["body_jaxpr"], [(i, False) for i in range(p["cond_nconsts"], len(eqn.invars))]
    else:
        for inner in p.values():
            if isinstance(inner, ClosedJaxpr) and len(inner.jaxpr.invars) == len(eqn.invars):
                yield inner, [(i, False) for i in range(len(eqn.invars))]


def _unwrapped(f: Failure, k: int, inner: ClosedJaxpr, pick: Any) -> Iterator[Failure]:
    """An inner function by itself, with the arguments that it has at first."""
    operands = f.jaxpr.jaxpr.eqns[k].invars
    known, shared = _values(f, [v for v in operands if not isinstance(v, Literal)])
    found = iter(zip(known, shared, strict=True))
    values = [(np.asarray(v.val, v.aval.dtype), True) if isinstance(v, Literal) else next(found) for v in operands]
    args = []
    for i, is_row in pick:
        x, same = values[i]
        if is_row and not x.shape[0 if same else 1]:
            return
        args.append(((x[0] if same else x[:, 0]) if is_row else x, same))
    for v in inner.jaxpr.outvars:
        if isinstance(v, Var):
            yield dataclasses.replace(
                f, jaxpr=_giving(inner, v), args=[x for x, _ in args], shared=[s for _, s in args],
                ulps=max(f.ulps, _ULPS), scale=_ULPS,
            )  # fmt: skip
