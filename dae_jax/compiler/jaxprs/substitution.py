"""Jaxprs with some of their equations, at any depth, replaced by what others compute; nothing is traced again."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from ..types import Atom, Equation
from .walk import PLAIN, called, is_open, once_each


class Substitution:
    """Called with a jaxpr it gives one that computes the same; itself where nothing is replaced.

    `replacement` gives what computes the results of an equation from its last operands, or `None` where the equation stays.
    `enters` says of an equation that stays whether what it holds is looked at.
    """

    def __init__(
        self,
        replacement: Callable[[Equation], ClosedJaxpr | None],
        enters: Callable[[Equation], bool] = lambda _: True,
    ) -> None:
        self._replacement, self._enters = replacement, enters
        self._found = once_each(self._substituted)

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        return self._found(closed)

    def _substituted(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        found, env = _Equations(), {}
        read = lambda v: v if isinstance(v, Literal) else env.get(v, v)
        for eqn in closed.jaxpr.eqns:
            args = list(map(read, eqn.invars))
            inner = self._in_place_of(eqn, args)
            if inner is None:
                found.eqns.append(self._kept(eqn, args))
            else:
                env.update(zip(eqn.outvars, found.splice(inner, args), strict=True))
        if not env and all(a is b for a, b in zip(found.eqns, closed.jaxpr.eqns, strict=True)):
            return closed
        return found.closed(closed, list(map(read, closed.jaxpr.outvars)))

    def _in_place_of(self, eqn: Equation, args: Sequence[Atom]) -> ClosedJaxpr | None:
        if eqn.primitive.name == "cond" and isinstance(args[0], Literal):
            branches = eqn.params["branches"]
            return self(branches[min(max(int(args[0].val), 0), len(branches) - 1)])
        inner = self._replacement(eqn)
        if inner is not None:
            return self(inner)
        inner = called(eqn)
        # Constants of what takes its place are nowhere to be kept in a jaxpr that is not closed.
        if inner is None or not any(map(is_open, eqn.params.values())) or not self._enters(eqn):
            return None
        found = self(inner)
        return None if found is inner else found

    def _kept(self, eqn: JaxprEqn, args: list[Atom]) -> JaxprEqn:
        params = {k: self._within(p) for k, p in eqn.params.items()} if self._enters(eqn) else eqn.params
        if all(a is b for a, b in zip(params.values(), eqn.params.values(), strict=True)):
            params = eqn.params
        same = params is eqn.params and all(a is b for a, b in zip(args, eqn.invars, strict=True))
        return eqn if same else eqn.replace(invars=args, params=params)

    def _within(self, param: Any) -> Any:
        """A parameter with what it holds substituted; itself where that is nothing."""
        if type(param) in PLAIN or is_open(param):
            return param
        if isinstance(param, ClosedJaxpr):
            return self(param)
        is_jaxpr = lambda x: isinstance(x, ClosedJaxpr | Jaxpr)
        leaves, treedef = jax.tree.flatten(param, is_leaf=is_jaxpr)
        changed = [self(x) if isinstance(x, ClosedJaxpr) else x for x in leaves]
        return param if all(a is b for a, b in zip(leaves, changed, strict=True)) else treedef.unflatten(changed)


class _Equations:
    """The equations and constants of a jaxpr that is being written."""

    def __init__(self) -> None:
        self.eqns: list[JaxprEqn] = []
        self.constants: list[tuple[Var, Any]] = []

    def splice(self, inner: ClosedJaxpr, args: Sequence[Atom]) -> list[Any]:
        """Writes down the equations of a jaxpr of the last operands; gives its results."""
        fresh = [(Var(v.aval), x) for v, x in zip(inner.jaxpr.constvars, inner.consts, strict=True)]
        self.constants += fresh
        env: dict[Any, Any] = dict(zip(inner.jaxpr.constvars, (v for v, _ in fresh), strict=True))
        env.update(zip(inner.jaxpr.invars, args[len(args) - len(inner.jaxpr.invars) :], strict=True))
        read = lambda v: v if isinstance(v, Literal) else env[v]
        for eqn in inner.jaxpr.eqns:
            outs = [Var(v.aval) for v in eqn.outvars]
            self.eqns.append(eqn.replace(invars=list(map(read, eqn.invars)), outvars=outs))
            env.update(zip(eqn.outvars, outs, strict=True))
        return list(map(read, inner.jaxpr.outvars))

    def closed(self, of: ClosedJaxpr, outputs: list[Any]) -> ClosedJaxpr:
        """The jaxpr, with the arguments of another."""
        constants = [*zip(of.jaxpr.constvars, of.consts, strict=True), *self.constants]
        effects = frozenset(e for eqn in self.eqns for e in eqn.effects)
        jaxpr = of.jaxpr.replace(constvars=[v for v, _ in constants], eqns=self.eqns, outvars=outputs, effects=effects)
        return ClosedJaxpr(jaxpr, [x for _, x in constants])
