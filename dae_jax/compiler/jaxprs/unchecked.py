"""Functions without the checks that their caller has made already."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Array, PyTree

from .._compat import is_check
from ..types import Arrays, Atom, Equation
from .walk import equations, equations_in


def without_checks(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn` without `equinox.error_if`: for conditions that the caller has looked at already."""

    def unchecked(*args: PyTree) -> Any:
        jaxpr, out = jax.make_jaxpr(fn, return_shape=True)(*args)
        results = _evaluate(jaxpr.jaxpr, jaxpr.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(out), results)

    return unchecked


def checks_dropped(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same for a function that is traced; itself where it has none, since tracing again takes time."""
    if not any(map(is_check, equations(closed))):
        return closed
    return jax.make_jaxpr(lambda *xs: _evaluate(closed.jaxpr, closed.consts, xs))(*closed.in_avals)


def _evaluate(jaxpr: Jaxpr, consts: Sequence[Array], args: Sequence[Array]) -> list[Any]:
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(v: Atom) -> Any:
        return v.val if isinstance(v, Literal) else env[v]

    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, _results(eqn, [read(v) for v in eqn.invars]), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _results(eqn: Equation, values: Arrays) -> list[Any]:
    """What an equation gives, without the checks in it."""
    name = eqn.primitive.name
    if name in ("jit", "pjit", "custom_jvp_call", "cond") and any(map(is_check, equations_in(eqn))):
        inner = _unchecked(eqn)
        if inner is not None:
            return _evaluate(inner.jaxpr, inner.consts, values[len(values) - len(inner.jaxpr.invars) :])
        if name == "cond":
            index, *operands = values
            branches = [lambda *xs, b=b: _evaluate(b.jaxpr, b.consts, xs) for b in eqn.params["branches"]]
            return jax.lax.switch(index, branches, *operands)
    results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return results if eqn.primitive.multiple_results else [results]


def _unchecked(eqn: Equation) -> ClosedJaxpr | None:
    """What to run in place of a check, or of a call with checks in it; `None` for other equations."""
    name = eqn.primitive.name
    if name == "cond":
        branches = eqn.params["branches"]
        checked = [any(map(is_check, b.jaxpr.eqns)) for b in branches]
        return branches[checked.index(False)] if any(checked) and not all(checked) else None
    if name in ("jit", "pjit"):
        return eqn.params["jaxpr"]
    if name == "custom_jvp_call" and any(map(_is_checking, eqn.params["call_jaxpr"].jaxpr.eqns)):
        return eqn.params["call_jaxpr"]
    return None


def _is_checking(eqn: Equation) -> bool:
    return eqn.primitive.name == "cond" and _unchecked(eqn) is not None
