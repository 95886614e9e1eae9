"""What a user's functions take from around them: a solve that is compiled already is not the one for other values of these.

    k = 9.81
    system = ConstrainedSystem(lambda t, q, v, args: -k * q, constraint)
    daesolve(system, ...)
    k = 1.0
    daesolve(system, ...)

A compiled program is known by its functions. Here each of them becomes one that is equal to itself only as long as the numbers,
arrays, containers, functions and attributes of objects are that it finds in its closure, its defaults, the globals it names, and
the object that it is a method of.
"""

import functools
import hashlib
import types
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np


T = TypeVar("T")

# Their functions and objects do not change.
LIBRARIES = frozenset(
    "builtins dae_jax diffrax equinox functools jax jaxlib jaxtyping lineax math numpy operator optax optimistix scipy".split()
)
# Containers and objects with more in them are known by what they are, not by what is in them.
MOST = 2000
# How many functions are remembered that have changed what is around them.
REMEMBERED = 1024
_before: dict["Captured", "Captured"] = {}


def current(tree: T) -> T:
    """The tree with its functions as they are with the values of now."""
    return jax.tree.map(_current, tree)


def settle(leaves: Iterable[object]) -> None:
    """To be called when functions have been traced: what they have changed themselves, such as a counter of their calls, makes no
    other functions of them.
    """
    for x in leaves:
        if isinstance(x, Captured):
            now = _current(x.__wrapped__)
            if isinstance(now, Captured) and now != x:
                _before[now] = x
    for oldest in list(_before)[:-REMEMBERED]:
        _before.pop(oldest, None)


class Captured:
    """A function that is equal to itself with the same values around it."""

    def __init__(self, fn: Callable[..., Any], values: Hashable) -> None:
        self.__wrapped__, self.values = fn, values
        self.__name__ = getattr(fn, "__name__", type(fn).__name__)
        self.__qualname__ = getattr(fn, "__qualname__", self.__name__)
        self.__doc__ = fn.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.__wrapped__(*args, **kwargs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured) and self.__wrapped__ == other.__wrapped__ and self.values == other.values

    def __hash__(self) -> int:
        return hash((self.__wrapped__, self.values))

    def __repr__(self) -> str:
        return repr(self.__wrapped__)


class Same:
    """An object that is equal to itself alone."""

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def values_of(fn: types.FunctionType, others: tuple[object, ...]) -> Hashable:
    """The values of the globals that a function names, and of other objects."""
    look = _Look()
    return tuple(look.globals(fn)), tuple(map(look.value, others))


def _current(x: Any) -> Any:
    if not callable(x) or isinstance(x, Captured | type) or _of_library(x):
        return x
    values = _Look().of_callable(x)
    if not values:
        return x
    found = Captured(x, values)
    return _before.get(found, found) if _before else found


def _of_library(x: object) -> bool:
    if isinstance(x, functools.partial):
        return False
    module = getattr(x, "__module__", None) or getattr(type(x), "__module__", "")
    return isinstance(module, str) and module.partition(".")[0] in LIBRARIES


class _TooMuch(Exception):
    pass


class _Look:
    """One look at all that a function can reach; `seen` are the objects on the way here."""

    def __init__(self) -> None:
        self.seen: list[object] = []
        self.count = 0

    def of_callable(self, x: Any) -> Hashable:
        """The values around a function, a method or an object with `__call__`; empty where there are none."""
        if isinstance(x, types.FunctionType):
            return tuple(self.around(x))
        if isinstance(x, types.MethodType):
            return (*self.around(x.__func__), ("self", self.value(x.__self__)))
        if isinstance(x, functools.partial):
            return (self.value(x.func), self.value(x.args), self.value(x.keywords))
        return (self.value(x),) if hasattr(x, "__dict__") and not hasattr(x, "__wrapped__") else ()

    def around(self, fn: Any) -> Iterator[tuple[str, Hashable]]:
        """The values that matter, by name."""
        yield from self.globals(fn)
        code = fn.__code__
        for name, cell in zip(code.co_freevars, fn.__closure__ or (), strict=True):
            try:
                yield from self._named(name, cell.cell_contents)
            except ValueError:  # a name that has no value yet
                continue
        for k, x in enumerate(fn.__defaults__ or ()):
            yield from self._named(f"default {k}", x)
        for name, x in (fn.__kwdefaults__ or {}).items():
            yield from self._named(name, x)

    def globals(self, fn: Any) -> Iterator[tuple[str, Hashable]]:
        names, there = _names(fn.__code__), fn.__globals__
        for name in names:
            if name not in there:
                continue
            x = there[name]
            if not isinstance(x, types.ModuleType):
                yield from self._named(name, x)
            elif x.__name__.partition(".")[0] not in LIBRARIES:
                for attribute in names:
                    if attribute in vars(x):
                        yield from self._named(f"{name}.{attribute}", vars(x)[attribute])

    def _named(self, name: str, x: object) -> Iterator[tuple[str, Hashable]]:
        found = self.value(x)
        if found is not None:
            yield name, found

    def value(self, x: Any) -> Hashable:
        """`None` for what has no value that could change."""
        if x is None or isinstance(x, bool | int | str | bytes | complex):
            return type(x), x
        if isinstance(x, float):
            return float, x.hex()
        if isinstance(x, np.ndarray | np.generic):
            return _of_numbers(np.asarray(x))
        if isinstance(x, jax.Array):
            return Same(x)
        module = isinstance(x, eqx.Module)
        if isinstance(x, types.ModuleType | type) or (not module and callable(x) and _of_library(x)):
            return None
        if any(x is outer for outer in self.seen):
            return "within itself"
        self.seen.append(x)
        try:
            return self._of_parts(x)
        finally:
            self.seen.pop()

    def _of_parts(self, x: Any) -> Hashable:
        if len(self.seen) == 1:
            self.count = 0
        try:
            if isinstance(x, tuple | list):
                return (type(x), *map(self._counted, x))
            if isinstance(x, dict):
                return (dict, *((Same(k) if k.__hash__ is None else k, self._counted(y)) for k, y in x.items()))
            if isinstance(x, types.FunctionType | types.MethodType | functools.partial):
                return Same(getattr(x, "__func__", x)), self.of_callable(x)
            if isinstance(x, eqx.Module) or (hasattr(x, "__dict__") and not _of_library(x)):
                return (Same(type(x)), *((name, self._counted(y)) for name, y in vars(x).items()))
        except _TooMuch:
            if len(self.seen) > 1:
                raise
        return Same(x)

    def _counted(self, x: object) -> Hashable:
        self.count += 1
        if self.count > MOST:
            raise _TooMuch
        return self.value(x)


def _of_numbers(x: np.ndarray) -> Hashable:
    if x.dtype == object:
        return Same(x)
    bits = x.tobytes()
    return x.shape, x.dtype.str, bits if len(bits) <= 64 else hashlib.blake2b(bits).digest()


@functools.lru_cache(maxsize=1024)
def _names(code: types.CodeType) -> tuple[str, ...]:
    """The names that a function, and those that are written in it, may look up."""
    within = (name for x in code.co_consts if isinstance(x, types.CodeType) for name in _names(x))
    return tuple(dict.fromkeys((*code.co_names, *within)))
