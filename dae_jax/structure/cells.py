"""The abstract value behind `incidence`: for each entry of an array, what it depends on or the number that it is."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from ..compiler.types import Aval, Equation
from .sets import Ids, Sets


class Cells:
    """An array of a jaxpr, entry by entry.

    **Attributes**, all of the array's shape:

    - `dependence`: the inputs that the entry depends on, as the id of a set in the `Sets` of the interpretation.
    - `known`: whether the entry is the same number whatever the inputs are; it then depends on nothing.
    - `value`: that number; without meaning where not known.

    Arrays may be views of one another: nothing writes into them.
    """

    __slots__ = ("dependence", "known", "value")

    def __init__(self, dependence: Ids | int, known: np.ndarray | bool, value: ArrayLike) -> None:
        self.dependence = np.asarray(dependence, np.int64)
        self.known = np.asarray(known, bool)
        self.value = np.asarray(value)

    @classmethod
    def constant(cls, value: ArrayLike) -> "Cells":
        """Known numbers."""
        value = np.asarray(value)
        return cls(np.zeros(value.shape, np.int64), np.ones(value.shape, bool), value)

    @classmethod
    def unknown(cls, dependence: Ids | int, aval: Aval) -> "Cells":
        """Entries with the given dependence, broadcast to the shape of `aval`."""
        dependence = broadcast(np.asarray(dependence, np.int64), aval.shape)
        return cls(dependence, np.zeros(aval.shape, bool), np.zeros(aval.shape, placeholder(aval).dtype))

    @property
    def shape(self) -> tuple[int, ...]:
        return self.dependence.shape

    @property
    def nonzero(self) -> np.ndarray:
        """False where the entry is known to be 0."""
        return ~(self.known & (self.value == 0))

    def map(self, move: Callable[[np.ndarray], np.ndarray]) -> "Cells":
        """Entries moved about: `move` applied to all three arrays."""
        return Cells(move(self.dependence), move(self.known), move(self.value))

    def also(self, dependence: Ids, sets: Sets) -> "Cells":
        """The same entries, those not known with a further dependence (which broadcasts)."""
        return Cells(unless(self.known, sets.union(self.dependence, dependence)), self.known, self.value)

    def join(self, other: "Cells", sets: Sets) -> "Cells":
        """What is one or the other: known only where both are known and equal."""
        known = self.known & other.known & (self.value == other.value)
        return Cells(unless(known, sets.union(self.dependence, other.dependence)), known, self.value)

    def within(self, other: "Cells", sets: Sets) -> bool:
        """Whether `join` would add nothing to `other`."""
        joined = other.join(self, sets)
        return np.array_equal(joined.known, other.known) and sets.equal(joined.dependence, other.dependence)


def placeholder(aval: Aval) -> np.ndarray:
    """A zero of the dtype of `aval`; a boolean for dtypes that numpy has not, such as random keys."""
    return np.zeros((), bool if has_extended_dtype(aval) else aval.dtype)


def has_extended_dtype(aval: Aval) -> bool:
    """Whether the entries are no numbers but, for instance, random keys."""
    return jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended)


def evaluate(eqn: Equation, values: Sequence[np.ndarray]) -> list[Any]:
    """The outputs of one equation of a jaxpr on numbers, also while an outer function is being traced."""
    with jax.ensure_compile_time_eval():
        out = eqn.primitive.bind(*values, **eqn.params)
    return list(out) if eqn.primitive.multiple_results else [out]


def broadcast(a: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """`np.broadcast_to`, which takes its time also where there is nothing to do."""
    return a if a.shape == shape else np.broadcast_to(a, shape)


def unless(mask: np.ndarray | bool, dependence: Ids | int) -> Ids:
    """The dependence, and nothing where `mask`."""
    return np.where(mask, _NOTHING, dependence)


_NOTHING = np.zeros((), np.int64)
