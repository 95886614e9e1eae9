"""Jaxprs without calls: what these do stands in their place, equal equations are there once, unused ones not at all."""

from collections.abc import Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive, Var, jaxpr_as_fun
from jaxtyping import Array

from ..types import Atom, Aval, Equation, aval_of
from .few_turns import written_out
from .special_functions import SPECIAL, by_simpler_ones
from .walk import atom_key, called, identity, needed_for, of_solve, once_each, params_key


# They give their first operand, or what is said here; others of equinox mean something to transformations only.
_GIVES = {
    **dict.fromkeys(
        "copy copy_p stop_gradient nonbatchable nontraceable nondifferentiable_backward unvmap_max".split(), 0
    ),
    "select_if_vmap": 1,
}
_BY_OTHERS = frozenset({"unvmap_any", "unvmap_all", "maybe_set"})
_SAME_IF_SO_SHAPED = frozenset({"reshape", "broadcast_in_dim", "convert_element_type", "squeeze", "expand_dims"})
_COMMUTATIVE = frozenset({"add", "add_any", "mul", "max", "min", "and", "or", "xor", "eq", "ne"})


# A call that stays one; its parameter `jaxpr` is the function.
PROCEDURE = Primitive("procedure")
PROCEDURE.multiple_results = True


class Inlining:
    """Jaxprs without calls but those of procedures, each found once.

    Called with a jaxpr it gives one that computes the same; functions with the identities `procedures` stay functions.
    """

    def __init__(self, procedures: frozenset[Hashable] = frozenset()) -> None:
        self.procedures = procedures
        self._found = once_each(lambda closed: _flat(closed, self))

    def __call__(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        return self._found(closed)


def _flat(closed: ClosedJaxpr, inlined: Inlining) -> ClosedJaxpr:
    flat = _Flat(inlined)
    inputs = [Var(v.aval) for v in closed.jaxpr.invars]
    outputs = flat.run(closed, inputs)
    eqns, needed = needed_for(outputs, flat.eqns)
    constants = [(v, x) for v, x in flat.constants.values() if v in needed]
    jaxpr = closed.jaxpr.replace(constvars=[v for v, _ in constants], invars=inputs, outvars=outputs, eqns=eqns)
    return ClosedJaxpr(jaxpr, [x for _, x in constants])


class _Flat:
    def __init__(self, inlined: Inlining) -> None:
        self.inlined = inlined
        self.eqns: list[JaxprEqn] = []
        self.constants: dict[int, tuple[Var, Any]] = {}
        self._known: dict[Hashable, list[Any]] = {}
        self._made: dict[Any, JaxprEqn] = {}

    def run(self, closed: ClosedJaxpr, args: Sequence[Atom]) -> list[Any]:
        """Writes down the equations of a jaxpr; gives the variables of its results."""
        env: dict[Any, Any] = dict(zip(closed.jaxpr.invars, args, strict=True))
        for v, x in zip(closed.jaxpr.constvars, closed.consts, strict=True):
            env[v], _ = self.constants.setdefault(id(x), (Var(v.aval), x))
        read = lambda v: v if isinstance(v, Literal) else env[v]
        for eqn in closed.jaxpr.eqns:
            env.update(zip(eqn.outvars, self._equation(eqn, list(map(read, eqn.invars))), strict=True))
        return list(map(read, closed.jaxpr.outvars))

    def _equation(self, eqn: JaxprEqn, args: list[Atom]) -> list[Any]:
        name, p = eqn.primitive.name, eqn.params
        inner = called(eqn)
        if inner is not None and identity(inner) not in self.inlined.procedures:
            return self.run(inner, args)
        if inner is not None:
            eqn, name = eqn.replace(primitive=PROCEDURE, params={"jaxpr": inner}), PROCEDURE.name
        if name in _GIVES:
            return [args[_GIVES[name]]]
        if name in SPECIAL:
            return self.run(by_simpler_ones(eqn), args)
        if name == "custom_linear_solve":
            return self.run(p["jaxprs"].solve, of_solve(p, args))
        if name in _BY_OTHERS:
            scalar = name != "maybe_set" and not aval_of(args[0]).ndim
            return args[:1] if scalar else self.run(_meaning(eqn), args)
        if name == "while" and eqn.params["cond_jaxpr"].out_avals[0].shape:
            eqn, args = _until_all_are_done(eqn, args)
        if name == "while" and (turns := written_out(eqn, args, self._made.get, self.inlined)) is not None:
            return self.run(turns, args)
        if name in _SAME_IF_SO_SHAPED and _like(aval_of(args[0]), aval_of(eqn.outvars[0])):
            return args[:1]
        atoms = list(map(atom_key, args))
        key = (name, params_key(eqn.params), frozenset(atoms) if name in _COMMUTATIVE else tuple(atoms))
        found = None if eqn.effects else self._known.get(key)
        if found is None:
            found = self._known[key] = [Var(v.aval) for v in eqn.outvars]
            self.eqns.append(eqn.replace(invars=args, outvars=found))
            self._made.update(dict.fromkeys(found, self.eqns[-1]))
        return found


def _until_all_are_done(eqn: JaxprEqn, args: list[Atom]) -> tuple[JaxprEqn, list[Any]]:
    """A loop with a condition for each of several elements, as `vmap` makes it: what is done stays as it is."""
    p = eqn.params
    n, m = p["cond_nconsts"], p["body_nconsts"]
    condition, body = map(jaxpr_as_fun, (p["cond_jaxpr"], p["body_jaxpr"]))

    def any_goes_on(*xs: Array) -> Any:
        return jnp.any(condition(*xs)[0])

    def turn(*xs: Array) -> list[Any]:
        carry = xs[n + m :]
        (goes_on,) = condition(*xs[:n], *carry)
        here = lambda x: jax.lax.broadcast_in_dim(goes_on, x.shape, range(goes_on.ndim))
        return [jax.lax.select(here(x), y, x) for x, y in zip(carry, body(*xs[n:]), strict=True)]

    structs = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in map(aval_of, args)]
    params = {
        **p,
        "cond_jaxpr": jax.make_jaxpr(any_goes_on)(*structs[:n], *structs[n + m :]),
        "body_jaxpr": jax.make_jaxpr(turn)(*structs),
        "body_nconsts": n + m,
    }
    return eqn.replace(params=params), [*args[:n], *args]


def _like(a: Aval, b: Aval) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype


def _meaning(eqn: Equation) -> ClosedJaxpr:
    """A primitive of equinox by others."""
    structs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
    return jax.make_jaxpr(lambda *xs: eqn.primitive.impl(*xs, **eqn.params))(*structs)
