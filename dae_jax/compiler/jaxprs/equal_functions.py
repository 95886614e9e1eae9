"""Functions that compute the same in the same way, as one: what is differentiated is traced anew for each derivative of it."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from jax.extend.core.primitives import closed_call_p

from ..thresholds import THRESHOLDS
from ..types import Atom, Equation
from .walk import PLAIN, atom_key, called, needed_for, once_each, params_key


class _Function(NamedTuple):
    """A function of those arguments at `places` of a call; its results are those at `computed`, and of the others `given` says which
    argument each is, or which result.
    """

    closed: ClosedJaxpr
    places: Sequence[int]
    computed: Sequence[int]
    given: dict[int, Callable[[JaxprEqn], Atom]]


class EqualFunctions:
    """Called with a jaxpr it gives one that computes the same. Functions that are called in it are one object where they are equal but for
    the names of their variables, the order of their arguments and equations, and what they do not use or hand through; what loops and
    branches run is one object where it is equal but for names and the order of equations.
    """

    def __init__(self) -> None:
        self._first: dict[Hashable, ClosedJaxpr] = {}
        self._found = once_each(self._within)
        self._run = once_each(self._first_run)
        self._function = once_each(self._first_called)

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        return self._found(closed)

    def _within(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        env, eqns = {}, []
        read = lambda v: v if isinstance(v, Literal) else env.get(v, v)
        for eqn in closed.jaxpr.eqns:
            eqn = eqn.replace(invars=list(map(read, eqn.invars)))
            inner = called(eqn)
            if inner is None:
                eqns.append(eqn.replace(params={k: self._param(p) for k, p in eqn.params.items()}))
                continue
            function = self._function(inner)
            env |= {eqn.outvars[k]: of(eqn) for k, of in function.given.items()}
            eqns.append(
                eqn.replace(
                    primitive=closed_call_p,
                    invars=[eqn.invars[k] for k in function.places],
                    outvars=[eqn.outvars[k] for k in function.computed],
                    params={"call_jaxpr": function.closed},
                )
            )
        return ClosedJaxpr(
            closed.jaxpr.replace(eqns=eqns, outvars=list(map(read, closed.jaxpr.outvars))), closed.consts
        )

    def _param(self, param: Any) -> Any:
        if type(param) in PLAIN:
            return param
        if isinstance(param, ClosedJaxpr):
            return self._run(param)
        leaves, treedef = jax.tree.flatten(param, is_leaf=_is_closed)
        return treedef.unflatten(map(self._param, leaves)) if any(map(_is_closed, leaves)) else param

    def _first_run(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        """The first of all that are equal to this one, of what loops and branches run."""
        found = self(closed)
        return self._first.setdefault(content(found), found)

    def _first_called(self, closed: ClosedJaxpr) -> _Function:
        """The first of all functions that are equal to this one."""
        found, of_function = _parted(self(closed))
        return found._replace(closed=self._first.setdefault(of_function, found.closed))


def content(closed: ClosedJaxpr) -> Hashable:
    """What is the same of functions that compute the same in the same way, but for names and the order of equations, while they and what
    they call are there.
    """
    jaxpr = closed.jaxpr
    eqns, _ = _in_order(jaxpr, jaxpr.outvars)
    return _content((*jaxpr.constvars, *jaxpr.invars), closed.consts, eqns, jaxpr.outvars)


def _is_closed(x: object) -> bool:
    return isinstance(x, ClosedJaxpr)


def _parted(closed: ClosedJaxpr) -> tuple[_Function, Hashable]:
    """What a function computes, with the arguments and constants that it needs in the order of their first use; and what equal functions
    have in common, in which what they call is one object already.
    """
    jaxpr = closed.jaxpr
    place = {v: k for k, v in enumerate(jaxpr.invars)}
    computed, given, first = [], {}, {}
    for k, v in enumerate(jaxpr.outvars):
        if isinstance(v, Literal):
            given[k] = lambda _, v=v: v
        elif v in place:
            given[k] = lambda eqn, at=place[v]: eqn.invars[at]
        elif v in first:
            given[k] = lambda eqn, at=first[v]: eqn.outvars[at]
        else:
            first[v] = k
            computed.append(k)
    outvars = [jaxpr.outvars[k] for k in computed]
    eqns, leaves = _in_order(jaxpr, outvars)
    constant = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    constvars, invars = [v for v in leaves if v in constant], [v for v in leaves if v in place]
    kept, _ = needed_for(outvars, jaxpr.eqns)
    found = ClosedJaxpr(
        jaxpr.replace(constvars=constvars, invars=invars, outvars=outvars, eqns=kept),
        [constant[v] for v in constvars],
    )
    of_function = _content((*constvars, *invars), found.consts, eqns, outvars)
    return _Function(found, [place[v] for v in invars], computed, given), of_function


def _in_order(jaxpr: Jaxpr, outvars: Iterable[Atom]) -> tuple[list[JaxprEqn], list[Var]]:
    """The equations that results need, and the variables that come from outside, each when it is needed first."""
    source = {v: eqn for eqn in jaxpr.eqns for v in eqn.outvars}
    eqns, leaves, seen = [], {}, set()
    roots = [*outvars, *(v for eqn in jaxpr.eqns if eqn.effects for v in eqn.outvars)]
    waiting: list[Any] = [v for v in reversed(roots) if isinstance(v, Var)]
    while waiting:
        top = waiting.pop()
        if isinstance(top, JaxprEqn):
            eqns.append(top)
        elif top not in source:
            leaves[top] = None
        elif id(source[top]) not in seen:
            seen.add(id(source[top]))
            waiting.append(source[top])
            waiting += [v for v in reversed(source[top].invars) if isinstance(v, Var)]
    return eqns, list(leaves)


def _content(
    arguments: Sequence[Var], constants: Sequence[Any], eqns: Sequence[Equation], outvars: Sequence[Atom]
) -> Hashable:
    number: dict[Var, int] = {}
    defined = lambda vs: tuple((number.setdefault(v, len(number)), v.aval) for v in vs)
    used = lambda vs: tuple(number[v] if isinstance(v, Var) else atom_key(v) for v in vs)
    given = defined(arguments), tuple(map(_constant, constants))
    found = tuple((eqn.primitive, params_key(eqn.params), used(eqn.invars), defined(eqn.outvars)) for eqn in eqns)
    return given, found, used(outvars)


def _constant(x: Any) -> Hashable:
    known = isinstance(x, np.ndarray | np.generic | jax.Array) and not isinstance(x, Tracer)
    if not known or x.size > THRESHOLDS.folded or not isinstance(x.dtype, np.dtype):
        return id(x)
    return x.shape, x.dtype, np.asarray(x).tobytes()
