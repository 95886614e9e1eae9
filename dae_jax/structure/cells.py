"""The abstract value behind `incidence`: for each entry of an array, what it depends on or the number that it is."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from ..compiler.types import Aval, Equation


class Cells:
    """An array of a jaxpr, entry by entry.

    **Attributes**, all of the array's shape:

    - `dependence`: the inputs that the entry depends on, as a set of bits in a Python integer (dtype object).
    - `known`: whether the entry is the same number whatever the inputs are; it then depends on nothing.
    - `value`: that number; without meaning where not known.

    Arrays may be views of one another: nothing writes into them.
    """

    __slots__ = ("dependence", "known", "value")

    def __init__(self, dependence: np.ndarray | int, known: np.ndarray | bool, value: ArrayLike) -> None:
        self.dependence = as_sets(dependence)
        self.known = np.asarray(known, bool)
        self.value = np.asarray(value)

    @classmethod
    def constant(cls, value: ArrayLike) -> "Cells":
        """Known numbers."""
        value = np.asarray(value)
        return cls(np.broadcast_to(_NOTHING, value.shape), np.broadcast_to(_TRUE, value.shape), value)

    @classmethod
    def unknown(cls, dependence: np.ndarray | int, aval: Aval) -> "Cells":
        """Entries with the given dependence, broadcast to the shape of `aval`."""
        dependence = np.broadcast_to(as_sets(dependence), aval.shape)
        return cls(dependence, np.broadcast_to(_FALSE, aval.shape), np.broadcast_to(placeholder(aval), aval.shape))

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

    def also(self, dependence: np.ndarray | int) -> "Cells":
        """The same entries, those not known with a further dependence (which broadcasts)."""
        return Cells(unless(self.known, self.dependence | dependence), self.known, self.value)

    def join(self, other: "Cells") -> "Cells":
        """What is one or the other: known only where both are known and equal."""
        known = self.known & other.known & (self.value == other.value)
        return Cells(unless(known, self.dependence | other.dependence), known, self.value)

    def within(self, other: "Cells") -> bool:
        """Whether `join` would add nothing to `other`."""
        joined = other.join(self)
        return np.array_equal(joined.known, other.known) and np.array_equal(joined.dependence, other.dependence)


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


def unless(mask: np.ndarray | bool, dependence: np.ndarray | int) -> np.ndarray:
    """The dependence, and nothing where `mask`."""
    return np.where(mask, _NOTHING, as_sets(dependence))


def union(dependence: np.ndarray, axes: tuple[int, ...], keepdims: bool = False) -> np.ndarray:
    """The union of the dependences along `axes`."""
    return as_sets(np.bitwise_or.reduce(dependence, axis=axes, initial=0, keepdims=keepdims))


def as_sets(dependence: np.ndarray | int) -> np.ndarray:
    """An array of Python integers. numpy's own would overflow, and it makes one of a scalar wherever it can."""
    if isinstance(dependence, np.ndarray) and dependence.dtype != object:
        raise AssertionError(f"Dependences must be Python integers, not {dependence.dtype}.")
    return np.asarray(dependence, object)


def as_rows(sets: Sequence[int], n: int) -> np.ndarray:
    """Sets of bits as the rows of a boolean matrix with n columns."""
    n_bytes = (n + 7) // 8
    packed = np.frombuffer(b"".join(bits.to_bytes(n_bytes, "little") for bits in sets), np.uint8)
    return np.unpackbits(packed.reshape(len(sets), n_bytes), axis=1, count=n, bitorder="little").astype(bool)


_NOTHING = np.zeros((), object)
_FALSE, _TRUE = np.zeros((), bool), np.ones((), bool)
