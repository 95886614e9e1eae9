"""What a user's functions take from around them: a solve that is compiled already is not the one for other values of these.

    k = 9.81
    system = ConstrainedSystem(lambda t, q, v, args: -k * q, constraint)
    daesolve(system, ...)
    k = 1.0
    daesolve(system, ...)

A compiled program is known by its functions. Here each of them becomes one that is equal only to those of the same code, a `lambda`
that is made anew for one, and only as long as the numbers, arrays, containers, functions, classes and attributes of objects are the
same that it finds in its closure, its defaults, the globals and modules it names, and the object that it is a method of. An object
that is handed over as it is, in `args`, becomes a copy that is another one when what is in it has changed.
"""

import contextlib
import copy
import dataclasses
import functools
import types
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from .around import Look, Same, code_of, is_installed, of_library


T = TypeVar("T")

# How many functions are remembered that have changed what is around them, and how many objects that may change.
REMEMBERED = 1024
_before: dict["Captured", "Captured"] = {}
_known: weakref.WeakValueDictionary[Hashable, "Captured"] = weakref.WeakValueDictionary()
_copies: dict[Hashable, Any] = {}


def current(tree: T) -> T:
    """The tree with its functions, and its objects that are no pytrees, as they are with the values of now.

    Errors: `TypeError` for an object that is no pytree and has no hash.
    """
    return jax.tree.map(_current, tree, is_leaf=_is_function_with_leaves)


def settle(leaves: Iterable[object]) -> None:
    """To be called when functions have been traced: what they have changed themselves meanwhile, such as a counter of their calls,
    makes no other functions of them.
    """
    for x in leaves:
        if isinstance(x, Captured):
            now = _current(x.__wrapped__)
            if isinstance(now, Captured) and now != x:
                _before[now] = x
    for oldest in list(_before)[:-REMEMBERED]:
        _before.pop(oldest, None)


@contextlib.contextmanager
def settled(leaves: Iterable[object]) -> Iterator[None]:
    """The same around tracing that may come long after the functions were looked at, as that of a derivative does: what has changed
    in between makes others of them.
    """
    untouched = [x for x in leaves if isinstance(x, Captured) and _current(x.__wrapped__) == x]
    yield
    settle(untouched)


class Captured:
    """All functions of the same code with the same values around them. `__wrapped__` is the one that was looked at last: what is
    around another may have changed since.
    """

    def __init__(self, fn: Callable[..., Any], key: Hashable) -> None:
        self.__wrapped__, self.key = fn, key
        self._hash = hash(self.key)
        self.__name__ = getattr(fn, "__name__", type(fn).__name__)
        self.__qualname__ = getattr(fn, "__qualname__", self.__name__)
        self.__doc__ = fn.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.__wrapped__(*args, **kwargs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured) and self._hash == other._hash and self.key == other.key

    def __hash__(self) -> int:
        return self._hash

    def __repr__(self) -> str:
        return repr(self.__wrapped__)


@functools.partial(jax.tree_util.register_dataclass, data_fields=("fn",), meta_fields=("values",))
@dataclasses.dataclass(frozen=True)
class CapturedModule:
    """A module that is called, with arrays of its own, and what its class takes from around it."""

    fn: Any
    values: Hashable

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.fn(*args, **kwargs)

    @property
    def __wrapped__(self) -> Callable[..., Any]:
        """What `inspect.signature` reads."""
        return self.fn


def _is_function_with_leaves(x: object) -> bool:
    return isinstance(x, eqx.Module) and callable(x) and not is_installed(type(x).__module__)


def _current(x: Any) -> Any:
    if _is_function_with_leaves(x):
        return CapturedModule(x, Look().value(type(x)))
    if isinstance(x, Captured | CapturedModule | type | jax.Array | np.ndarray):
        return x
    if x.__hash__ is None:
        name = type(x).__name__
        raise TypeError(
            f"A {name} is no pytree: JAX does not see the numbers in it. Make {name} an `equinox.Module`, register it by "
            "`jax.tree_util.register_dataclass`, or hand over a dictionary."
        )
    if of_library(x):
        return x
    if not callable(x):
        return _copied(x)
    values = Look().of_callable(x)
    if not values and not isinstance(x, types.FunctionType):
        return x
    key = code_of(x), values
    found = _known.get(key) or _known.setdefault(key, Captured(x, key))
    found = _before.get(found, found) if _before else found
    found.__wrapped__ = x
    return found


def _copied(x: Any) -> Any:
    """An object in place of `x` that is the same one as long as the same is in it."""
    key = Same(x), Look().value(x)
    if key not in _copies:
        _copies[key] = copy.copy(x)
        for oldest in list(_copies)[:-REMEMBERED]:
            _copies.pop(oldest)
    return _copies[key]
