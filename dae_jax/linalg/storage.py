"""Square matrices that are factorised once and used many times, real or complex: dense, or in a band.

A matrix is an array of what its storage keeps of it; `factor` gives a pytree of arrays, `solve` uses it, and both are
derived by JAX in both modes. The unknowns of a band are reordered inside: vectors go in and come out in their own order.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Inexact, Int, PyTree

from ..types import IntScalar
from .dense import LOOPED


@dataclasses.dataclass(frozen=True)
class Dense:
    """All entries. Up to 32 unknowns the factors are the inverse, found in plain arithmetic, so that to solve is one sum;
    LU by LAPACK above.
    """

    size: int

    # Whether to factorise takes as long as many solutions do; whether it needs columns that are graded by powers of the step size.
    dear: ClassVar[bool] = False
    graded: ClassVar[bool] = True

    def describe(self) -> str:
        """In words."""
        how = "inverses in plain arithmetic" if self.size <= LOOPED else "LU by LAPACK"
        return f"dense, {self.size} × {self.size}, {how}"

    def positions(self) -> tuple[Int[np.ndarray, "n n"], Int[np.ndarray, "n n"]]:
        """Row and column of each entry."""
        rows, columns = np.indices((self.size, self.size))
        return rows, columns

    def factor(self, a: Inexact[Array, "n n"]) -> Any:
        """The factors."""
        scale = _row_scale(a)
        if self.size <= LOOPED:
            return _inverse(a * scale[:, None]) * scale
        return (*lax.linalg.lu(a * scale[:, None]), scale)

    def solve(self, factors: PyTree, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with A x = b."""
        if self.size <= LOOPED:
            return jnp.sum(factors * b, 1)
        lu, _, order, scale = factors
        y = lax.linalg.triangular_solve(lu, (scale * b)[order][:, None], left_side=True, lower=True, unit_diagonal=True)
        return lax.linalg.triangular_solve(lu, y, left_side=True)[:, 0]

    def apply(self, a: Inexact[Array, "n n"], x: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """A x."""
        return jnp.sum(a * x, 1) if self.size <= LOOPED else jnp.dot(a, x, precision=lax.Precision.HIGHEST)

    def scale_columns(self, a: Inexact[Array, "n n"], scale: Inexact[Array, " n"]) -> Inexact[Array, "n n"]:
        """A diag(scale)."""
        return a * scale

    def least_squares(self, a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """About the least x that makes |A x − b| least, for a singular A; repeat with what remains of b."""
        scale = _row_scale(a)[:, None]
        a = a * scale
        if self.size <= LOOPED:
            # XLA makes a product out of a sum of this size, which is a library call.
            outer = lambda i, s: s + a[i][:, None] * a[i]
            product = lax.fori_loop(0, self.size, outer, jnp.zeros_like(a))
        else:
            product = jnp.dot(a.T, a, precision=lax.Precision.HIGHEST)
        factors = self.factor(product + cutoff(jnp.sum(a * a, 1)) * jnp.eye(self.size, dtype=a.dtype))
        return self.solve(factors, jnp.sum(a * (scale * b[:, None]), 0))

    def coupled(
        self, parts: list[Inexact[Array, "n n"]], others: list[Inexact[Array, "n n"]], weights: Float[Array, "s s"]
    ) -> tuple["Dense", Inexact[Array, "sn sn"]]:
        """The matrix of s coupled copies, block (i, j) = δᵢⱼ partsᵢ + weightsᵢⱼ othersᵢ, unknowns of a copy interleaved."""
        s = len(parts)
        blocks = jnp.stack(
            [jnp.stack([(parts[i] if i == j else 0) + weights[i, j] * others[i] for j in range(s)]) for i in range(s)]
        )
        return Dense(s * self.size), jnp.transpose(blocks, (2, 0, 3, 1)).reshape(s * self.size, s * self.size)


@dataclasses.dataclass(frozen=True, eq=False)
class Banded:
    """Entry (i, i + k − `lower`) at [i, k], for k up to `lower` + `upper`, after `rows` and `columns` are put in order.

    Compared by identity. Source of the elimination: G. H. Golub, C. F. Van Loan, *Matrix Computations*, 4.3.3.
    """

    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    lower: int
    upper: int

    dear: ClassVar[bool] = False
    graded: ClassVar[bool] = True

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return len(self.rows)

    @property
    def width(self) -> int:
        """Entries kept of a row."""
        return self.lower + 1 + self.upper

    def describe(self) -> str:
        """In words."""
        return f"a band of {self.lower} diagonals below and {self.upper} above, {self.size} unknowns"

    def positions(self) -> tuple[Int[np.ndarray, "n width"], Int[np.ndarray, "n width"]]:
        """Row and column, in the vectors' own order, of each entry; −1 for columns outside."""
        places = np.arange(self.size)[:, None] + np.arange(-self.lower, self.upper + 1)
        inside = (places >= 0) & (places < self.size)
        columns = np.where(inside, self.columns[np.clip(places, 0, self.size - 1)], -1)
        return np.broadcast_to(self.rows[:, None], columns.shape), columns

    def factor(self, a: Inexact[Array, "n width"]) -> Any:
        """The factors, by Gaussian elimination with partial pivoting in a window that moves down the band."""
        scale = scaling(_along_rows(jnp.maximum, magnitude(a)))
        lower, reach = self.lower, self.lower + self.upper + 1
        if not lower:
            return a * scale[:, None], scale
        # Row i + lower joins when column i is eliminated; below the matrix stands the identity.
        rows = jnp.concatenate([a * scale[:, None], jnp.zeros((lower, self.width), a.dtype)])
        padded = jnp.pad(rows, ((0, 0), (0, reach - self.width)))
        padded = padded.at[self.size :, lower].set(1)
        window = jnp.stack([jnp.roll(padded[i], i - lower) for i in range(lower)])
        window = jnp.stack([jnp.where(np.arange(reach) < reach - lower + i, window[i], 0) for i in range(lower)])
        places = jnp.arange(lower + 1)

        def eliminate(window: Any, row: Any) -> Any:
            window = jnp.concatenate([window, row[None]])
            pivot = jnp.argmax(magnitude(window[:, 0]))
            pivot_row = lax.dynamic_index_in_dim(window, pivot, 0, keepdims=False)
            rest = jnp.where((places == pivot)[:, None], window[0], window)[1:]
            factors = rest[:, 0] / pivot_row[0]
            rest = rest[:, 1:] - factors[:, None] * pivot_row[1:]
            return jnp.pad(rest, ((0, 0), (0, 1))), (pivot_row, factors, pivot)

        _, (upper, factors, pivots) = lax.scan(eliminate, window, padded[lower:])
        return upper, factors, pivots, scale

    def solve(self, factors: PyTree, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """x with A x = b."""
        upper, *eliminations, scale = factors
        b = (b[self.rows] * scale).astype(jnp.result_type(b, upper))
        lower, ahead = self.lower, upper.shape[1] - 1
        if lower:
            lower_factors, pivots = eliminations
            places = jnp.arange(lower + 1)
            padded = jnp.concatenate([b, jnp.zeros(lower, b.dtype)])

            def forward(window: Any, given: PyTree) -> Any:
                entry, factors, pivot = given
                window = jnp.concatenate([window, entry[None]])
                first = jnp.sum(jnp.where(places == pivot, window, 0))
                rest = jnp.where(places == pivot, window[0], window)[1:]
                return rest - factors * first, first

            _, b = lax.scan(forward, padded[:lower], (padded[lower:], lower_factors, pivots))

        def backward(window: Any, given: PyTree) -> Any:
            entry, row = given
            x = (entry - jnp.sum(row[1:] * window)) / row[0]
            return jnp.concatenate([x[None], window])[:ahead], x

        _, x = lax.scan(backward, jnp.zeros(ahead, b.dtype), (b, upper), reverse=True)
        return x[np.argsort(self.columns)]

    def apply(self, a: Inexact[Array, "n width"], x: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """A x."""
        _, columns = self.positions()
        return _along_rows(jnp.add, a * jnp.where(columns >= 0, x[columns], 0))[np.argsort(self.rows)]

    def scale_columns(self, a: Inexact[Array, "n width"], scale: Inexact[Array, " n"]) -> Inexact[Array, "n width"]:
        """A diag(scale)."""
        return a * scale[self.positions()[1]]

    def least_squares(self, a: Float[Array, "n width"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """About the least x that makes |A x − b| least, for a singular A; repeat with what remains of b.

        From r + A x = b and Aᵀ r = ε x, which has a band too.
        """
        n, reach = self.size, max(self.lower, self.upper)
        scale = scaling(_along_rows(jnp.maximum, magnitude(a)))
        a = a * scale[:, None]
        offsets = np.arange(-reach, reach + 1)
        wide = jnp.pad(a, ((0, 0), (reach - self.lower, reach - self.upper)))
        # Entry (i, i + k) of Aᵀ is entry (i + k, i) of A.
        rows = np.arange(n)[:, None] + offsets
        inside = (rows >= 0) & (rows < n)
        transposed = jnp.where(inside, wide[np.clip(rows, 0, n - 1), reach - offsets], 0)
        diagonal = jnp.broadcast_to(jnp.asarray(offsets == 0, a.dtype), wide.shape)
        in_place = Banded(np.arange(n), np.arange(n), reach, reach)
        cut = cutoff(_along_rows(jnp.add, a * a))
        both, matrix = in_place.coupled(
            [diagonal, -cut * diagonal], [wide, transposed], jnp.asarray([[0.0, 1.0], [1.0, 0.0]], a.dtype)
        )
        factors = both.factor(matrix)
        right = jnp.stack([b[self.rows] * scale, jnp.zeros_like(b)], 1).reshape(-1)
        return both.solve(factors, right)[1::2][np.argsort(self.columns)]

    def coupled(
        self,
        parts: list[Inexact[Array, "n width"]],
        others: list[Inexact[Array, "n width"]],
        weights: Float[Array, "s s"],
    ) -> tuple["Banded", Inexact[Array, "sn width"]]:
        """The matrix of s coupled copies, block (i, j) = δᵢⱼ partsᵢ + weightsᵢⱼ othersᵢ, unknowns of a copy interleaved."""
        s, n = len(parts), self.size
        rows = []
        for i in range(s):
            entries = jnp.stack([(parts[i] if i == j else 0) + weights[i, j] * others[i] for j in range(s)], 2)
            rows.append(jnp.pad(entries.reshape(n, s * self.width), ((0, 0), (s - 1 - i, i))))
        interleave = lambda order: (s * order[:, None] + np.arange(s)).reshape(-1)
        band = Banded(interleave(self.rows), interleave(self.columns), s * self.lower + s - 1, s * self.upper + s - 1)
        return band, jnp.stack(rows, 1).reshape(s * n, -1)


def cutoff(squares: Float[Array, " n"]) -> Float[Array, ""]:
    """Squared singular values of A below this count as 0, by the sums of squares of its rows."""
    largest = jnp.max(squares)
    return 100 * jnp.finfo(squares.dtype).eps * jnp.where(largest > 0, largest, 1)


def _row_scale(a: Inexact[Array, "n k"]) -> Float[Array, " n"]:
    return scaling(jnp.max(magnitude(a), 1))


def scaling(largest: Float[Array, " n"]) -> Float[Array, " n"]:
    """What makes the largest entry of each row 1, of rows that are not 0."""
    return 1 / jnp.where(largest > 0, largest, 1)


def _along_rows(combine: Callable[[Array, Array], Array], a: Inexact[Array, "n k"]) -> Inexact[Array, " n"]:
    """A reduction of each row of a band. XLA hands that of a large matrix to a library, column by column it does not."""
    return functools.reduce(combine, [a[:, k] for k in range(a.shape[1])])


def magnitude(x: Inexact[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Of the order of |x|, without a square root."""
    return jnp.abs(jnp.real(x)) + jnp.abs(jnp.imag(x)) if jnp.iscomplexobj(x) else jnp.abs(x)


def _inverse(a: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """The inverse by Gauss–Jordan elimination with partial pivoting, in place."""
    n = a.shape[0]
    places = jnp.arange(n)

    def eliminate(j: IntScalar, carry: Any) -> Any:
        a, order = carry
        column = lax.dynamic_slice_in_dim(a, j, 1, 1)[:, 0]
        pivot = jnp.argmax(jnp.where(places >= j, magnitude(column), -1))
        row_j = lax.dynamic_index_in_dim(a, j, 0)
        row_pivot = lax.dynamic_index_in_dim(a, pivot, 0)
        value = lax.dynamic_index_in_dim(column, pivot, 0, keepdims=False)
        row = jnp.where(places == j, 1, row_pivot) * (1 / value)
        at_j, at_pivot = places == j, places == pivot
        column = jnp.where(at_pivot, lax.dynamic_index_in_dim(column, j, 0, keepdims=False), column)
        # The rows change places, a unit vector takes the column's; what becomes of row j is of no account.
        a = lax.dynamic_update_slice_in_dim(a, row_j, pivot, 0)
        a = lax.dynamic_update_slice_in_dim(a, jnp.zeros((n, 1), a.dtype), j, 1)
        a = lax.dynamic_update_slice_in_dim(a - column[:, None] * row, row, j, 0)
        first, second = order[j], order[pivot]
        order = jnp.where(at_j, second, jnp.where(at_pivot, first, order))
        return a, order

    a, order = lax.fori_loop(0, n, eliminate, (a, places))
    # The columns of the inverse are those of the rows as they were exchanged.
    back = jnp.sum(jnp.where(order[:, None] == places, places[:, None], 0), 0)
    return a[:, back]
