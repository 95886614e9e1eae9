"""Sparse Jacobians as few directional derivatives, and gradients of the rows that have many entries."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array

from ..structure import column_colouring, shape_of
from ..types import Flat, IntScalar


# Rows of more entries may be found by themselves, each of which takes as long as so many directions.
FULL, GRADIENT = 50, 4


@dataclasses.dataclass(frozen=True, eq=False)
class Compression:
    """A Jacobian as directional derivatives, one for each colour of its columns (−1: in none), and the gradients of the `full`
    rows; `places`: where its stored entries are among these numbers (−1: 0).
    """

    colours: Int[np.ndarray, " n"]
    places: Int[np.ndarray, "*stored"]
    full: Int[np.ndarray, " full"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))

    @classmethod
    def of(
        cls,
        pattern: csr_array,
        rows: Int[np.ndarray, "*stored"],
        columns: Int[np.ndarray, "*stored"],
        used: Bool[np.ndarray, "*stored"],
    ) -> "Compression":
        """For the entries at (`rows`, `columns`), of which those `used` are in the pattern."""
        m, n = shape_of(pattern)
        lengths = np.diff(pattern.indptr)
        full = np.flatnonzero(lengths > FULL)
        others = np.delete(np.arange(m), full)
        if GRADIENT * len(full) >= lengths.max(initial=0) - lengths[others].max(initial=0):
            full, others = full[:0], np.arange(m)
        colours = column_colouring(pattern[others])
        forward = colours[columns] * m + rows
        backward = _count(colours) * m + np.searchsorted(full, rows) * n + columns
        return cls(colours, np.where(used, np.where(np.isin(rows, full), backward, forward), -1), full)

    @property
    def count(self) -> int:
        """How many colours there are."""
        return _count(self.colours)

    def jacobian(self, fn: Callable[[Flat], Flat], x: Float[Array, " n"]) -> Float[Array, "*stored"]:
        """The stored entries of ∂fn/∂x."""
        seeds = (jnp.asarray(self.colours) == jnp.arange(self.count)[:, None]).astype(x.dtype)
        found = jax.vmap(lambda seed: jax.jvp(fn, (x,), (seed,))[1])(seeds).reshape(-1)
        if len(self.full):
            found = jnp.concatenate([found, self._gradients(fn, x).reshape(-1)])
        return jnp.where(self.places >= 0, found[self.places], 0)

    def _gradients(self, fn: Callable[[Flat], Flat], x: Float[Array, " n"]) -> Float[Array, "full n"]:
        rows = lambda x: fn(x)[self.full]
        try:
            return jax.jacrev(rows)(x)
        except ValueError:  # a loop that has no reverse mode
            entry = lambda j: jax.jvp(rows, (x,), (_unit(j, x),))[1]
            return jax.lax.map(entry, jnp.arange(x.size)).T


def _count(colours: Int[np.ndarray, " n"]) -> int:
    return int(colours.max(initial=-1)) + 1


def _unit(j: IntScalar, x: Flat) -> Flat:
    return (jnp.arange(x.size) == j).astype(x.dtype)
