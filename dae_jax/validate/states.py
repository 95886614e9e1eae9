"""What the user gives as system and state: wrong types and shapes are refused in a sentence."""

import dataclasses
import inspect
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.typing import ArrayLike
from jaxtyping import PyTree

from ..systems import AbstractSystem, System, is_implicit, is_mechanism
from ..types import State, Time


NUMBERS = (jax.Array, np.ndarray, np.generic, jax.ShapeDtypeStruct, float, int, complex, bool)


def brief(x: object) -> str:
    """A short repr; a class or a function that was not called is named as such."""
    if isinstance(x, type):
        return f"the class {x.__name__}: write {x.__name__}(...)"
    function = inspect.unwrap(x) if callable(x) else x
    if inspect.isfunction(function):
        return f"the function {function.__name__}"
    if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(x)):
        return describe(x)
    text = repr(x)
    return text if len(text) < 200 else text[:200] + "…"


def counted(number: int, noun: str, plural: str = "") -> str:
    """`number` things: "1 constraint", "2 constraints", "1 degree", "2 degrees of freedom"."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def describe(tree: PyTree) -> str:
    """The types and shapes of a pytree, in short: float64[2]."""
    text = repr(jax.tree.map(lambda x: _Shape(x) if isinstance(x, NUMBERS) else x, tree))
    return text if len(text) < 120 else text[:120] + "…"


class _Shape:
    """Shown as float64[2]."""

    def __init__(self, x: ArrayLike | np.generic | jax.ShapeDtypeStruct) -> None:
        self.text = ShapedArray(jnp.shape(x), jnp.result_type(x)).str_short()

    def __repr__(self) -> str:
        return self.text


def refuse_wrong_system(system: System) -> None:
    """Refuses what is none of the three systems."""
    if not isinstance(system, AbstractSystem):
        kind = f"the class {system.__name__}" if isinstance(system, type) else f"a {type(system).__name__}"
        if callable(getattr(system, "system", None)) and not isinstance(system, type):
            kind += ": hand over its `.system()`"
        raise TypeError(f"`system` must be a dae_jax.ConstrainedSystem, SemiExplicitDAE or ImplicitDAE, but is {kind}.")


def refuse_wrong_state(system: System, y0: State, name: str = "y0") -> None:
    """Refuses a state of another structure than the system's: (q, v), (x, z) or any pytree of numbers."""
    refuse_wrong_system(system)
    if hasattr(y0, "ys") and hasattr(y0, "ts"):
        raise ValueError(
            f"`{name}` must be a state, but is a solution: go on from its last state with `{name}=sol.final`."
        )
    if len(system.parts) > 1:
        _refuse_no_pair(y0, name, system.pair, _how_to_split(y0, name) if is_mechanism(system) else "")
    if is_mechanism(system):
        q, v = y0
        _refuse_unlike(q, v, name)
    leaves = jax.tree.leaves(y0)
    if not leaves:
        raise ValueError(f"`{name}` must hold numbers, but is empty: {brief(y0)}.")
    for leaf in leaves:
        if not isinstance(leaf, NUMBERS):
            raise TypeError(f"`{name}` must hold arrays of floating-point numbers, but holds {brief(leaf)}.")
    if not any(map(math.prod, map(jnp.shape, leaves))):
        raise ValueError(f"`{name}` must hold numbers, but its arrays are empty: {describe(y0)}.")


def refuse_not_finite(name: str, state: State) -> None:
    """Refuses NaN and infinity, where they are known."""
    for leaf in jax.tree.leaves(state):
        if not isinstance(leaf, Tracer) and not np.all(np.isfinite(np.asarray(leaf))):
            raise ValueError(f"`{name}` must be finite, but has NaN or infinity: {brief(leaf)}.")


def refuse_no_time(name: str, value: Time | None) -> None:
    """Refuses what is no finite real number."""
    is_number = type(value) is float or (isinstance(value, NUMBERS) and jnp.shape(value) == ())
    if not is_number or np.dtype(jnp.result_type(value)).kind not in "fiu":
        raise ValueError(f"`{name}` must be a real number, but is {brief(value)}.")
    if not isinstance(value, Tracer) and not np.isfinite(np.asarray(value)):
        raise ValueError(f"`{name}` must be finite, but is {value}.")


def as_floats(state: State) -> Any:
    """The state as arrays, whole numbers as floating-point ones."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), state)


def _how_to_split(y0: State, name: str) -> str:
    """Advice for a vector in which v is behind q."""
    flat = isinstance(y0, jax.Array | np.ndarray) and np.ndim(y0) == 1 and np.size(y0) % 2 == 0
    n = np.size(y0) // 2 if flat else 0
    return f"; if v is behind q in it, write `{name}=(y[:{n}], y[{n}:])`" if flat else ""


def _refuse_no_pair(y0: State, name: str, pair: str, advice: str) -> None:
    if not isinstance(y0, tuple | list) or len(y0) != 2:
        raise ValueError(f"`{name}` must be the pair {pair}, but is {brief(y0)}{advice}.")


def _refuse_unlike(q: State, v: State, name: str) -> None:
    if jax.tree.structure(q) != jax.tree.structure(v):
        raise ValueError(
            f"`{name}` = (q, v): q and v must have the same structure, but are {describe(q)} and {describe(v)}."
        )
    for a, b in zip(jax.tree.leaves(q), jax.tree.leaves(v), strict=True):
        if np.shape(a) != np.shape(b):
            raise ValueError(
                f"`{name}` = (q, v): q and v must have the same shape, but have {np.shape(a)} and {np.shape(b)}."
            )


def broadcast_to_state(name: str, tree: PyTree, state: State, what: str) -> Any:
    """`tree`, of the structure of `state`, with its leaves in the shapes there.

    Errors: `ValueError` where that cannot be.
    """
    if jax.tree.structure(tree) == jax.tree.structure(state):
        try:
            return jax.tree.map(lambda x, y: jnp.broadcast_to(jnp.asarray(x), jnp.shape(y)), tree, state)
        except (TypeError, ValueError):
            pass
    raise ValueError(
        f"`{name}` must hold {what} in the structure of the state, {describe(state)}, but is {describe(tree)}."
    )


def with_rates(system: System, yd0: State, state: State) -> Any:
    """The system with `yd0`, ẏ near the start, where that is given; refuses one for a system that is explicit in ẏ."""
    if yd0 is None:
        return system
    if not is_implicit(system):
        raise ValueError(
            f"`yd0` is for an ImplicitDAE, whose equations may have several solutions ẏ; those of a "
            f"{type(system).__name__} give one."
        )
    return dataclasses.replace(system, yd0=broadcast_to_state("yd0", yd0, state, "numbers"))
