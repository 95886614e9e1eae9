"""What a function or an object can reach, as something that is equal as long as the same is in it: numbers, arrays, containers,
functions by their code, classes, attributes.
"""

import contextvars
import ctypes
import functools
import hashlib
import itertools
import marshal
import mmap
import re
import sys
import sysconfig
import types
import weakref
from array import array
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer


# Their functions and objects do not change.
LIBRARIES = frozenset(
    "builtins dae_jax diffrax equinox functools jax jaxlib jaxtyping lineax math numpy operator optax optimistix scipy".split()
)
# Containers and objects with more than so many containers and objects in them are known by what they are.
MOST = 2000
_CONTAINERS = frozenset({list, tuple, dict, set, frozenset, deque, array})
# Of any size these are known by what is in them, where that is of these types.
_PLAIN = frozenset({list, tuple, dict})
# Known by their bytes.
_BUFFERS = (bytearray, memoryview, mmap.mmap, ctypes.Array, ctypes.Structure, ctypes.Union, ctypes._SimpleCData)
# Functions by which others are found whose names are in a text.
_BY_NAME = frozenset({"eval", "exec", "globals", "locals", "vars"})
_PRIMITIVE = frozenset({type(None), bool, int, float, complex, str, bytes})
# What Python keeps with every class, and what changes without meaning.
_OF_EVERY_CLASS = frozenset(
    "__dict__ __weakref__ __module__ __doc__ __qualname__ __slots__ __annotations__ __abstractmethods__ _abc_impl".split()
)
# Arrays of JAX with up to so many numbers are known by these, larger ones by what they are: they do not change.
SMALL = 64


class Same:
    """An object that is equal to itself alone."""

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def code_of(fn: Any) -> Hashable:
    """What a function is but for the values around it; of other callables these are all."""
    fn = getattr(fn, "__func__", fn)
    return (_interned(fn.__code__), Same(fn.__globals__)) if isinstance(fn, types.FunctionType) else type(fn)


@functools.lru_cache(maxsize=4096)
def _interned(code: types.CodeType) -> "Same":
    """One object for all equal codes, whose hash takes no time."""
    return Same(code)


def values_of(fn: types.FunctionType, others: tuple[object, ...]) -> Hashable:
    """The values of the globals that a function names, and of other objects."""
    look = Look()
    return tuple(look.globals(fn)), tuple(map(look.value, others))


def of_library(x: object) -> bool:
    """Whether it is one of JAX's, numpy's, Python's, this library's."""
    if isinstance(x, functools.partial):
        return False
    module = getattr(x, "__module__", None) or getattr(type(x), "__module__", "")
    return isinstance(module, str) and _is_library(module)


class _TooMuch(Exception):
    pass


class Look:
    """One look at all that a function can reach; `seen` are the objects on the way here, `modules` those looked at."""

    def __init__(self) -> None:
        self.seen: list[object] = []
        self.modules: list[types.ModuleType] = []
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
                x = cell.cell_contents
            except ValueError:  # a name that has no value yet
                continue
            yield from self._named(name, x, _names(code))
        for k, x in enumerate(fn.__defaults__ or ()):
            yield from self._named(f"default {k}", x)
        for name, x in ((fn.__kwdefaults__ or {}) | fn.__dict__).items():
            yield from self._named(name, x)

    def globals(self, fn: Any) -> Iterator[tuple[str, Hashable]]:
        names, there = _names(fn.__code__), fn.__globals__
        for name in names:
            if name in there:
                yield from self._named(name, there[name], names)
            elif name in sys.modules and not is_installed(name):  # that the function imports, perhaps
                yield from self._named(name, sys.modules[name], names)

    def _named(self, name: str, x: object, names: tuple[str, ...] = ()) -> Iterator[tuple[str, Hashable]]:
        """A value under its name; of a module, those under `names` in it."""
        yield name, self.value(x)
        if isinstance(x, types.ModuleType) and x not in self.modules and not _is_library(x.__name__):
            self.modules.append(x)
            for attribute in names:
                if attribute in vars(x):
                    yield from self._named(f"{name}.{attribute}", vars(x)[attribute], names)

    def value(self, x: Any) -> Hashable:
        """What is equal as long as `x` is the same, and has the same in it."""
        if x is None or isinstance(x, bool | int | str | bytes | complex):
            return type(x), x
        if isinstance(x, float):
            return float, x.hex()
        if isinstance(x, np.ma.MaskedArray):
            return np.ma.MaskedArray, self.value(x.data), self.value(np.ma.getmaskarray(x))
        if isinstance(x, np.ndarray | np.generic):
            x = np.asarray(x)
            return _of_numbers(x) if x.dtype != object else (x.shape, self.value(tuple(x.ravel())))
        if isinstance(x, types.ModuleType):
            return Same(x)
        if isinstance(x, jax.Array):
            small = (
                not isinstance(x, Tracer) and x.size <= SMALL and isinstance(x.dtype, np.dtype) and not x.is_deleted()
            )
            return (x.weak_type, _of_numbers(np.asarray(x))) if small else Same(x)
        if isinstance(x, type):
            return Same(x) if is_installed(x.__module__) else self._guarded(x, self._of_class)
        if not isinstance(x, eqx.Module) and callable(x) and of_library(x):
            return Same(x)
        return self._guarded(x, self._of_parts)

    def _guarded(self, x: object, look: Callable[[Any], Hashable]) -> Hashable:
        if any(x is outer for outer in self.seen):
            return "within itself"
        if not self.seen:
            self.count = 0
        before = self.count
        self.seen.append(x)
        try:
            return look(x)
        except _TooMuch:
            # What is large itself is known by what it is, what is beside it by what is in that.
            if len(self.seen) > 1 and self.count - before < MOST // 2:
                raise
            self.count = before + MOST // 20
            return Same(x)
        finally:
            self.seen.pop()

    def _of_parts(self, x: Any) -> Hashable:
        if isinstance(x, types.FunctionType | types.MethodType | functools.partial):
            return code_of(x), self.of_callable(x)
        if isinstance(x, _BUFFERS):
            return Same(x), hashlib.blake2b(memoryview(x).tobytes()).digest()
        if isinstance(x, contextvars.ContextVar):
            return Same(x), self._counted(_of_variable(x))
        if isinstance(x, weakref.ref):
            return Same(x), self._counted(x())
        if isinstance(x, property):
            return tuple(map(self._counted, (x.fget, x.fset)))
        if isinstance(x, staticmethod | classmethod):
            return self._counted(x.__func__)
        found: list[Hashable] = []
        if type(x) in _PLAIN and len(x) > MOST // 20 and _PRIMITIVE.issuperset(map(type, _entries(x))):
            return type(x), hashlib.blake2b(marshal.dumps(x, 2)).digest()
        if isinstance(x, dict | types.MappingProxyType):
            found += [(Same(k) if k.__hash__ is None else k, self._counted(y)) for k, y in x.items()]
        elif isinstance(x, set | frozenset):
            found.append(frozenset(map(self._counted, x)))
        elif isinstance(x, list | tuple | deque | array):
            found += map(self._counted, x)
        hidden = of_library(x) and not isinstance(x, eqx.Module)
        attributes = {} if hidden else _attributes(x)
        if not found and not attributes and type(x) not in _CONTAINERS:
            return Same(x), self.value(type(x))
        found += [(name, self._counted(y)) for name, y in attributes.items()]
        return self.value(type(x)), *found

    def _of_class(self, x: type) -> Hashable:
        own = ((name, y) for name, y in vars(x).items() if name not in _OF_EVERY_CLASS)
        above = (*x.__bases__, type(x))
        return Same(x), *((name, self._counted(y)) for name, y in own), *map(self._counted, above)

    def _counted(self, x: object) -> Hashable:
        self.count += 1
        if self.count > MOST:
            raise _TooMuch
        return self.value(x)


def _attributes(x: object) -> dict[str, Any]:
    """An object's own attributes, also those that its classes have slots for."""
    slots = [name for of in type(x).__mro__ for name in _tuple(vars(of).get("__slots__", ()))]
    found = {name: getattr(x, name) for name in slots if name not in _OF_EVERY_CLASS and hasattr(x, name)}
    return found | getattr(x, "__dict__", {})


def _of_variable(x: contextvars.ContextVar[Any]) -> Any:
    try:
        return x.get()
    except LookupError:  # it has no value yet
        return None


def _entries(x: Any) -> Iterable[object]:
    return itertools.chain(x.keys(), x.values()) if type(x) is dict else x


def _tuple(x: Any) -> tuple[str, ...]:
    return (x,) if isinstance(x, str) else tuple(x)


@functools.cache
def _is_library(module: str) -> bool:
    return module.partition(".")[0] in LIBRARIES


@functools.cache
def is_installed(module: str) -> bool:
    """Whether the classes of a module come with Python or with a package: they do not change."""
    place = getattr(sys.modules.get(module), "__file__", None)
    if _is_library(module) or module in sys.stdlib_module_names or "site-packages" in str(place):
        return True
    return str(place).startswith(sysconfig.get_path("stdlib"))


def _of_numbers(x: np.ndarray) -> Hashable:
    bits = x.tobytes()
    return x.shape, x.dtype.str, bits if len(bits) <= 64 else hashlib.blake2b(bits).digest()


@functools.lru_cache(maxsize=1024)
def _names(code: types.CodeType) -> tuple[str, ...]:
    """The names that a function, and those that are written in it, may look up."""
    within = (name for x in code.co_consts if isinstance(x, types.CodeType) for name in _names(x))
    texts = (x for x in code.co_consts if isinstance(x, str)) if _BY_NAME.intersection(code.co_names) else ()
    in_texts = (name for text in texts for name in re.findall(r"[^\W\d]\w*", text))
    return tuple(dict.fromkeys((*code.co_names, *within, *in_texts)))
