"""Functions that close over what an outer transformation traces, as pytrees: the traced numbers become arrays of the program.

    def loss(k):
        system = ConstrainedSystem(lambda t, q, v, args: -k * q, constraint)
        ...

    jax.grad(loss)

A compiled program takes no number that is being differentiated but through its arguments, and one that closes over what
`jit` or `vmap` trace is none of our kernels.
"""

import functools
import types
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer
from jax.tree_util import Partial
from jaxtyping import PyTree

from .around import Same, values_of


T = TypeVar("T")


def opened(tree: T) -> T:
    """The tree with each function among its leaves that closes over traced numbers as a pytree that has them as leaves."""
    leaves, treedef = jax.tree.flatten(tree)
    found = list(map(_opened, leaves))
    return tree if all(x is y for x, y in zip(found, leaves, strict=True)) else jax.tree.unflatten(treedef, found)


def _opened(leaf: Any, within: tuple[Any, ...] = ()) -> Any:
    """`leaf`, if it is a function that closes over traced numbers, as a pytree that has them as leaves and computes the same.

    Looked for in closures and defaults, in `functools.partial` and under `jax.jit`, and in functions that are in these, but not
    in attributes of objects that are no pytrees.
    """
    if not callable(leaf) or any(leaf is outer for outer in within):
        return leaf
    within = (*within, leaf)

    def look(tree: PyTree) -> PyTree:
        try:
            return jax.tree.map(lambda x: _opened(x, within), tree)
        except (TypeError, ValueError):  # a dictionary whose keys have no order
            return Same(tree)

    if isinstance(leaf, functools.partial):
        bound = look((leaf.func, leaf.args, leaf.keywords))
        return Partial(bound[0], *bound[1], **bound[2]) if _is_traced(bound) else leaf
    if not isinstance(leaf, types.FunctionType):
        # `jax.jit` keeps what it compiles; within a program it has nothing to add.
        inner = getattr(leaf, "__wrapped__", None)
        found = _opened(inner, within) if isinstance(inner, types.FunctionType) else inner
        return leaf if found is inner else found
    try:
        cells = [cell.cell_contents for cell in leaf.__closure__ or ()]
    except ValueError:  # a name that has no value yet
        return leaf
    captured = [*cells, *(leaf.__defaults__ or ()), *(leaf.__kwdefaults__ or {}).values()]
    values = list(map(look, captured))
    traced = list(map(_is_traced, values))
    if not any(traced):
        return leaf
    rest = tuple(None if t else Same(x) for x, t in zip(captured, traced, strict=True))
    return _Closure([x for x, t in zip(values, traced, strict=True) if t], _Body(leaf, rest))


def _is_traced(tree: PyTree) -> bool:
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


class _Body:
    """A function but for what it has captured; the same for a `lambda` that is made anew."""

    def __init__(self, fn: types.FunctionType, rest: tuple[Same | None, ...]) -> None:
        self.code, self.globals, self.name, self.rest = fn.__code__, fn.__globals__, fn.__qualname__, rest
        self.values = values_of(fn, tuple(None if x is None else x.value for x in rest))
        self.defaults, self.keywords = len(fn.__defaults__ or ()), tuple(fn.__kwdefaults__ or {})

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, _Body)
            and self.code is other.code
            and self.globals is other.globals
            and (self.rest, self.defaults, self.keywords) == (other.rest, other.defaults, other.keywords)
            and self.values == other.values
        )

    def __hash__(self) -> int:
        return hash((id(self.code), self.rest))

    def whole(self, captured: list[Any]) -> Callable[..., Any]:
        """The function with these in place of what was traced."""
        given = iter(captured)
        values = [next(given) if x is None else x.value for x in self.rest]
        count = len(self.code.co_freevars)
        cells = tuple(map(types.CellType, values[:count]))
        defaults, keywords = values[count : count + self.defaults], values[count + self.defaults :]
        fn = types.FunctionType(self.code, self.globals, self.name, tuple(defaults), cells)
        fn.__kwdefaults__ = dict(zip(self.keywords, keywords, strict=True))
        return fn


class _Closure(eqx.Module):
    """A function that has captured traced numbers."""

    captured: list[Any]
    body: _Body = eqx.field(static=True)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.body.whole(self.captured)(*args, **kwargs)

    @property
    def __wrapped__(self) -> Callable[..., Any]:
        """What `inspect.signature` reads."""
        return self.body.whole(self.captured)
