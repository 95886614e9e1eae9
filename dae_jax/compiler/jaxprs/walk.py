"""What is in a jaxpr."""

import enum
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var
from jaxtyping import PyTree

from ..types import Atom, Equation, Params, aval_of


T = TypeVar("T")

# Numbers computed. A step of DOP853 with its stages written out and in a loop: chain of 4 links 2.0 and 4.8 µs, of 8 links 4.0
# and 6.3 µs; of 16 links 8.8 and 8.5 µs, and 12 s to compile in place of 3.
LARGE = 4000


# Primitives that evaluate another jaxpr, and the parameter that holds it.
CALLS = {
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat2": "jaxpr",
}
# They have a derivative of their own, and the last one a batch.
WITH_DERIVATIVE = {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}
# Every primitive that calls a jaxpr, with the parameter that has it.
ALL_CALLS = {**CALLS, **WITH_DERIVATIVE, "custom_vmap_call": "call"}

# Parameters that hold no jaxpr; most are of the first, which are told at a glance.
PLAIN = frozenset({int, bool, float, str, type(None)})
_PLAIN_KINDS = int | float | str | np.dtype | np.generic | enum.Enum | None


# They are asked for at each level, of programs that do not change.
_known: weakref.WeakKeyDictionary[Jaxpr, tuple[Any, ...]] = weakref.WeakKeyDictionary()
_computed: weakref.WeakKeyDictionary[Jaxpr, int] = weakref.WeakKeyDictionary()


def equations(jaxpr: ClosedJaxpr | Jaxpr) -> tuple[Any, ...]:
    """The equations of a jaxpr, at any depth."""
    inner = _opened(jaxpr)
    if inner not in _known:
        every: list[Any] = []
        for eqn in inner.eqns:
            every.append(eqn)
            every += equations_in(eqn)
        _known[inner] = tuple(every)
    return _known[inner]


def _opened(jaxpr: ClosedJaxpr | Jaxpr) -> Any:
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


def numbers_computed(jaxpr: ClosedJaxpr | Jaxpr) -> int:
    """How many numbers the equations of a jaxpr give, at any depth."""
    inner = _opened(jaxpr)
    if inner not in _computed:
        own = sum(out.aval.size for eqn in inner.eqns for out in eqn.outvars if hasattr(out.aval, "size"))
        _computed[inner] = own + sum(numbers_computed(x) for eqn in inner.eqns for x in held_by(eqn))
    return _computed[inner]


def equations_in(eqn: Equation) -> list[Any]:
    """The equations of all jaxprs that an equation holds."""
    return [inner for jaxpr in held_by(eqn) for inner in equations(jaxpr)]


def held_by(eqn: Equation) -> Iterator[ClosedJaxpr | Jaxpr]:
    """The jaxprs that an equation holds."""
    for param in eqn.params.values():
        if type(param) not in PLAIN:
            yield from jaxprs_in(param)


def is_open(x: object) -> bool:
    """Whether a parameter is a jaxpr that has no constants of its own; from JAX 0.12 on all have."""
    return isinstance(x, Jaxpr) and not isinstance(x, ClosedJaxpr)


def closed_in(eqn: Equation) -> Iterator[ClosedJaxpr]:
    """The closed ones, such as those that a loop or a branch runs."""
    return (x for x in held_by(eqn) if isinstance(x, ClosedJaxpr))


def jaxprs_in(param: object) -> Iterator[ClosedJaxpr | Jaxpr]:
    """The jaxprs that a parameter of an equation holds."""
    if isinstance(param, ClosedJaxpr | Jaxpr):
        yield param
    elif isinstance(param, tuple | list):
        for x in param:
            if type(x) not in PLAIN:
                yield from jaxprs_in(x)
    elif not isinstance(param, _PLAIN_KINDS):
        is_jaxpr = lambda x: isinstance(x, ClosedJaxpr | Jaxpr)
        yield from filter(is_jaxpr, jax.tree.leaves(param, is_leaf=is_jaxpr))


def called(eqn: Equation, calls: Mapping[str, str] = ALL_CALLS) -> ClosedJaxpr | None:
    """The jaxpr that an equation evaluates, if it is one of these calls."""
    if eqn.primitive.name not in calls:
        return None
    inner = eqn.params[calls[eqn.primitive.name]]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def identity(closed: ClosedJaxpr) -> Hashable:
    """What is the same of two calls of one function."""
    return id(closed.jaxpr), *map(id, closed.consts)


def once_each(of: Callable[[ClosedJaxpr], T]) -> Callable[[ClosedJaxpr], T]:
    """`of`, which is asked once of each function."""
    # The functions are kept, so that none has the identity of another.
    known: dict[Hashable, tuple[ClosedJaxpr, T]] = {}

    def found(closed: ClosedJaxpr) -> T:
        key = identity(closed)
        if key not in known:
            known[key] = closed, of(closed)
        return known[key][1]

    return found


def atom_key(x: Atom) -> Hashable:
    """What is the same of a variable, or of a constant in its place, wherever it stands."""
    # By its bits: 0 and −0 are equal, and not the same; its text has eight digits.
    return (np.asarray(x.val).tobytes(), aval_of(x).dtype) if isinstance(x, Literal) else x


def params_key(params: Params) -> Hashable:
    """What equal equations have in common beside their operands."""
    return tuple((name, _param_key(params[name])) for name in sorted(params))


def _param_key(param: Any) -> Hashable:
    if isinstance(param, ClosedJaxpr):
        return identity(param)
    if isinstance(param, tuple | list):
        return type(param), tuple(map(_param_key, param))
    try:
        hash(param)
    except TypeError:
        return id(param)
    # 1, 1.0 and True are equal.
    return type(param), param


def needed_for(outputs: Iterable[Any], eqns: Sequence[Any]) -> tuple[list[Any], set[Any]]:
    """Those of the equations that outputs, or effects, need, and all variables that are needed."""
    needed, kept = {v for v in outputs if isinstance(v, Var)}, []
    for eqn in reversed(eqns):
        if eqn.effects or not needed.isdisjoint(eqn.outvars):
            kept.append(eqn)
            needed.update(v for v in eqn.invars if isinstance(v, Var))
    return kept[::-1], needed


def of_solve(p: Params, args: list[T]) -> list[T]:
    """The operands of a `custom_linear_solve` that the function which finds the solution takes."""
    start, count = sum(p["const_lengths"][:2]), p["const_lengths"].solve
    return args[start : start + count] + args[sum(p["const_lengths"]) :]


def is_large(fn: Callable[..., Any], *args: PyTree) -> bool:
    """Whether a function is better called at one place, in a loop: XLA compiles it anew for each place it is called at."""
    return numbers_computed(jax.make_jaxpr(fn)(*args)) > LARGE
