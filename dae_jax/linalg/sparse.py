"""Square sparse matrices that are factorised once and used many times."""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Inexact, Int, PyTree

from ..compiler import compiles
from .pivoted_lu import Augmented, PivotedLU
from .sparse_lu import eliminated, solved, solved_transposed
from .storage import cutoff, scaling
from .symbolic_lu import SymbolicLU, symbolic_lu


# Numbers of the factors above this power of 1/ε have lost too many digits.
GROWTH = 0.4
# Rows with up to this many times the mean number of entries are summed side by side.
UNEVEN = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Sparse:
    """The entries at (`rows`, `columns`), rows in order. Compared by identity: keep one for each pattern.

    `pairing`: the unknown that each equation is eliminated with; `of_rates`: which entries ∂F/∂ẏ has.

    The pivots are those of the pairing, whatever the numbers are, and the factors' pattern is known beforehand, so that it is
    loops over indices, one kernel (`sparse_lu`). Where numbers of the factors grow too much, as pivots are small, SuperLU
    takes over with partial pivoting, and also where our compiler does not serve.
    """

    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    pairing: Int[np.ndarray, " n"]
    of_rates: Bool[np.ndarray, " entries"]

    # To factorise takes as long as many solutions do.
    dear: ClassVar[bool] = True
    graded: ClassVar[bool] = True

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return len(self.pairing)

    @functools.cached_property
    def symbolic(self) -> SymbolicLU:
        """The order, and the fill."""
        return symbolic_lu(self.rows, self.columns, self.pairing)

    @functools.cached_property
    def _pivoted(self) -> PivotedLU:
        return PivotedLU(self.rows, self.columns, self.size)

    def describe(self) -> str:
        """In words."""
        return (
            f"sparse, {self.size:,} unknowns, {len(self.rows):,} entries, {len(self.symbolic.at):,} in the factors, "
            "SuperLU where pivots are small"
        )

    def positions(self) -> tuple[Int[np.ndarray, " entries"], Int[np.ndarray, " entries"]]:
        """Row and column of each entry."""
        return self.rows, self.columns

    def factor(self, a: Inexact[Array, " entries"]) -> Any:
        """The factors."""
        if not _compiled(a, self.symbolic):
            return a, None, jnp.asarray(True)
        factors = eliminated(lax.stop_gradient(a), self.symbolic)
        return a, factors, ~(factors.largest < float(jnp.finfo(a.dtype).eps) ** -GROWTH)

    def solve(self, factors: PyTree, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with A x = b; A's derivative is that of the equation."""
        a, lu, poor = factors
        at_hand = lax.stop_gradient(a)

        def inverse(transposed: bool, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
            pivoted = lambda: self._pivoted.inverse(at_hand, b, poor, transposed)
            if lu is None:
                return pivoted()
            kernel = solved_transposed if transposed else solved
            return lax.cond(poor, pivoted, lambda: kernel(lax.stop_gradient(lu), b, self.symbolic))

        return lax.custom_linear_solve(
            lambda x: self.apply(a, x),
            b.astype(jnp.result_type(a, b)),
            solve=lambda _, b: inverse(False, b),
            transpose_solve=lambda _, b: inverse(True, b),
        )

    def apply(self, a: Inexact[Array, " entries"], x: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """A x."""
        return self._row_sums(a * x[self.columns])

    def _row_sums(self, a: Inexact[Array, " entries"]) -> Inexact[Array, " n"]:
        counts = np.bincount(self.rows, minlength=self.size)
        width = int(counts.max(initial=0))
        if width * self.size > UNEVEN * len(self.rows):
            return jax.ops.segment_sum(a, self.rows, self.size, indices_are_sorted=True)
        # A scatter is done entry by entry; rows of about one length are columns of sums.
        first = np.cumsum(counts) - counts
        columns = [jnp.where(k < counts, a[np.where(k < counts, first + k, 0)], 0) for k in range(width)]
        return functools.reduce(jnp.add, columns, jnp.zeros(self.size, a.dtype))

    def scale_columns(self, a: Inexact[Array, " entries"], scale: Inexact[Array, " n"]) -> Inexact[Array, " entries"]:
        """A diag(scale)."""
        return a * scale[self.columns]

    def least_squares(self, a: Float[Array, " entries"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """About the least x that makes |A x − b| least, for a singular A; repeat with what remains of b.

        From r + A x = b and Aᵀ r = ε x.
        """
        scale = scaling(jax.ops.segment_max(jnp.abs(a), self.rows, self.size, indices_are_sorted=True))
        a = a * scale[self.rows]
        return self._augmented.solve(a, cutoff(self._row_sums(a * a)), b * scale, jnp.zeros_like(b))[1]

    @functools.cached_property
    def _augmented(self) -> Augmented:
        return Augmented(self.rows, self.columns, (self.size, self.size))

    def coupled(
        self,
        parts: list[Inexact[Array, " entries"]],
        others: list[Inexact[Array, " entries"]],
        weights: Float[Array, "s s"],
    ) -> tuple["Sparse", Inexact[Array, " coupled"]]:
        """The matrix of s coupled copies, block (i, j) = δᵢⱼ partsᵢ + weightsᵢⱼ othersᵢ, unknowns of a copy interleaved; the
        others have entries in `of_rates` only.
        """
        s = len(parts)
        storage, order = self._copies(s)
        blocks = [
            parts[i] + weights[i, i] * others[i] if i == j else (weights[i, j] * others[i])[self._rate_entries]
            for i in range(s)
            for j in range(s)
        ]
        return storage, jnp.concatenate(blocks)[order]

    @functools.cached_property
    def _rate_entries(self) -> Int[np.ndarray, " rates"]:
        return np.flatnonzero(self.of_rates)

    @functools.lru_cache(maxsize=4)  # noqa: B019
    def _copies(self, s: int) -> tuple["Sparse", Int[np.ndarray, " coupled"]]:
        """The storage of s coupled copies, and the order in which it has the entries of its blocks."""
        every, some = np.arange(len(self.rows)), self._rate_entries
        blocks = [(i, j, every if i == j else some) for i in range(s) for j in range(s)]
        rows = np.concatenate([s * self.rows[k] + i for i, _, k in blocks])
        columns = np.concatenate([s * self.columns[k] + j for _, j, k in blocks])
        of_rates = np.concatenate([self.of_rates[k] for *_, k in blocks])
        order = np.lexsort((columns, rows))
        pairing = (s * self.pairing[:, None] + np.arange(s)).reshape(-1)
        return Sparse(rows[order], columns[order], pairing, of_rates[order]), order


def _compiled(a: Inexact[Array, " entries"], symbolic: SymbolicLU) -> bool:
    """Whether our compiler makes the loops: entry by entry in XLA they would take a thousand times as long."""
    return compiles(eliminated, *jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (a, symbolic)))
