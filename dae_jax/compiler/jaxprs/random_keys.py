"""Functions in which random keys are the numbers that they consist of, with one axis more than the keys have."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

from .._compat import is_key, key_functions
from ..types import Arrays, Aval, Equation
from .walk import equations, equations_in


def without_keys(closed: ClosedJaxpr) -> ClosedJaxpr:
    """A jaxpr that computes the same; what passes keys in or out is left as it is."""
    edges = [v.aval for v in (*closed.jaxpr.invars, *closed.jaxpr.outvars)]
    if any(map(is_key, edges)) or not any(eqn.primitive.name.startswith("random_") for eqn in equations(closed)):
        return closed
    return _converted(closed)


def _converted(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The jaxpr of numbers, also of keys that it gets and gives."""
    return jax.make_jaxpr(lambda *xs: _run(closed, xs))(*(_struct(v.aval) for v in closed.jaxpr.invars))


def _struct(aval: Aval) -> jax.ShapeDtypeStruct:
    if not is_key(aval):
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.ShapeDtypeStruct((*aval.shape, *key_functions(aval.dtype).key_shape), jnp.uint32)


def _run(closed: ClosedJaxpr, args: Sequence[Array]) -> list[Any]:
    jaxpr = closed.jaxpr
    env: dict[Any, Any] = dict(zip(jaxpr.invars, args, strict=True))
    for v, x in zip(jaxpr.constvars, closed.consts, strict=True):
        env[v] = jax.random.key_data(x) if is_key(v.aval) else x
    read = lambda v: v.val if isinstance(v, Literal) else env[v]
    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, _equation(eqn, list(map(read, eqn.invars))), strict=True))
    return list(map(read, jaxpr.outvars))


def _equation(eqn: Equation, args: Arrays) -> list[Any]:
    name, keyed = eqn.primitive.name, any(is_key(v.aval) for v in (*eqn.invars, *eqn.outvars))
    if name in _OF_KEYS:
        return [_OF_KEYS[name](eqn, *args)]
    if any(map(_has_key, equations_in(eqn))):
        return _with_jaxprs(eqn, args)
    bind = lambda *xs: eqn.primitive.bind(*xs, **eqn.primitive.get_bind_params(eqn.params))
    if keyed:  # what moves keys moves each of their numbers
        axes = [-1 if is_key(v.aval) else None for v in eqn.invars]
        found = jax.vmap(bind, axes, -1)(*args)
    else:
        found = bind(*args)
    return list(found) if eqn.primitive.multiple_results else [found]


def _has_key(eqn: Equation) -> bool:
    return any(is_key(v.aval) for v in (*eqn.invars, *eqn.outvars))


def _with_jaxprs(eqn: Equation, args: Arrays) -> list[Any]:
    """An equation whose jaxprs have keys, with these converted."""
    changed: dict[str, Any] = {k: _converted(p) for k, p in eqn.params.items() if isinstance(p, ClosedJaxpr)}
    if "branches" in eqn.params:
        changed["branches"] = tuple(map(_converted, eqn.params["branches"]))
    if eqn.primitive.name in ("while", "scan", "cond"):
        return eqn.primitive.bind(*args, **{**eqn.params, **changed})
    (inner,) = changed.values()
    return _run(inner, args)


def _each(eqn: Equation, fn: Callable[..., Any], *args: Array) -> Any:
    """A function of one key, of all keys of an array."""
    for _ in range(eqn.invars[0].aval.ndim):
        fn = jax.vmap(fn)
    return fn(*args)


def _functions(eqn: Equation) -> Any:
    return key_functions(next(v.aval.dtype for v in (*eqn.invars, *eqn.outvars) if is_key(v.aval)))


_OF_KEYS: dict[str, Callable[..., Any]] = {
    "random_wrap": lambda eqn, x: x,
    "random_unwrap": lambda eqn, x: x,
    "random_clone": lambda eqn, x: x,
    "random_seed": lambda eqn, x: _each(eqn, _functions(eqn).seed, x),
    "random_split": lambda eqn, x: _each(eqn, lambda k: _functions(eqn).split(k, eqn.params["shape"]), x),
    "random_fold_in": lambda eqn, x, n: _each(eqn, _functions(eqn).fold_in, x, n),
    "random_bits": lambda eqn, x: _each(
        eqn, lambda k: _functions(eqn).random_bits(k, eqn.params["bit_width"], eqn.params["shape"]), x
    ),
}
