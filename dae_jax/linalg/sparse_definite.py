"""Sparse symmetric positive definite systems whose graph is no chain or tree: elimination along the diagonal, entry by entry."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..compiler import compiles
from .definite_factors import definite_pivot
from .semidefinite import semidefinite_solve
from .sparse_ldl import eliminated, solved
from .symbolic_ldl import SymbolicLDL, symbolic_ldl


# What an entry costs in a loop over indices, in parts of one in operations on whole vectors.
LOOPED_COST = 8


@dataclasses.dataclass(frozen=True, eq=False)
class SparseDefinite:
    """Matrices with couplings at (`rows`, `columns`), rows < columns. Compared by identity: keep one for each pattern.

    The order is one of little fill, found once; a definite matrix needs no other pivots. The elimination is loops over indices
    (`sparse_ldl`), which take little to compile; without our compiler it is dense.
    """

    size: int
    rows: Int[np.ndarray, " c"]
    columns: Int[np.ndarray, " c"]

    @classmethod
    def of(cls, pattern: Bool[np.ndarray, "n n"]) -> "SparseDefinite":
        """For matrices with the given symmetric pattern."""
        return cls(len(pattern), *np.nonzero(np.triu(pattern, 1)))

    @functools.cached_property
    def _places(self) -> tuple[Int[np.ndarray, " entries"], Int[np.ndarray, " entries"]]:
        own = np.arange(self.size)
        return np.concatenate([own, self.rows, self.columns]), np.concatenate([own, self.columns, self.rows])

    @functools.cached_property
    def symbolic(self) -> SymbolicLDL:
        """The order, and the fill."""
        return symbolic_ldl(self.size, self.rows, self.columns)

    @property
    def cost(self) -> int:
        """Of a solve, in multiplications on whole vectors."""
        return LOOPED_COST * (self.symbolic.cost + 2 * len(self.symbolic.at))

    def factors(self, diagonal: Float[Array, " n"], couplings: Float[Array, " c"]) -> tuple[Array, ...]:
        """What is found once for several solves with positive definite S, given by its diagonal and its entries at (`rows`, `columns`)."""
        entries, order = lax.stop_gradient(jnp.concatenate([diagonal, couplings])), self.symbolic
        if not compiles(eliminated, *jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (entries, order))):
            return ()
        u = eliminated(entries, order)
        pivots = definite_pivot(1 / u[order.start[:-1]], entries[order.order], self.size)
        return u, jnp.all(pivots > 0)

    def solve(
        self,
        diagonal: Float[Array, " n"],
        couplings: Float[Array, " c"],
        b: Float[Array, " n"],
        factors: Sequence[Array] | None = None,
    ) -> Float[Array, " n"]:
        """x with S x = b, by the `factors` of S if they are at hand. A pivot that is not positive beyond round-off gives NaN."""
        entries = jnp.concatenate([diagonal, couplings, couplings])
        found = lax.stop_gradient(self.factors(diagonal, couplings) if factors is None else factors)
        if not found:
            return semidefinite_solve(jnp.zeros((self.size, self.size), b.dtype).at[self._places].set(entries), b)

        u, regular = found

        def inverse(_: Any, b: Float[Array, " n"]) -> Float[Array, " n"]:
            return jnp.where(regular, solved(u, b, self.symbolic), jnp.nan)

        return lax.custom_linear_solve(functools.partial(self._apply, entries), b, inverse, inverse, symmetric=True)

    def _apply(self, entries: Float[Array, " entries"], x: Float[Array, " n"]) -> Float[Array, " n"]:
        rows, columns = self._places
        return jax.ops.segment_sum(entries * x[columns], rows, self.size)
