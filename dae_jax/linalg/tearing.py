"""Linear systems whose matrix has a known pattern and some known entries, reduced to a small core before they are solved.

An entry alone in its row or in its column is a pivot without choice. An entry that is a known number and the largest of
its row, or of its column, where these are known too, is one by the rule of partial pivoting (with rows and columns
exchanged in the first case). What such pivots leave is solved with pivoting at run time: for a mechanism in first-order
form a third of the unknowns, for a system of ODEs with few algebraic variables these alone.

Source: H. Elmqvist, M. Otter, *Methods for tearing systems of equations in object-oriented modeling*, ESM 1994; the count
of fill is Markowitz': I. S. Duff, A. M. Erisman, J. K. Reid, *Direct Methods for Sparse Matrices*, Oxford 1986.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiler import scalarise, subroutine
from .dense import LOOPED, UNROLLED, solve


# Elimination beyond this many products is left to the loop, which is less to compile.
MOST = 400


@dataclasses.dataclass(frozen=True)
class _Step:
    """A pivot, the other rows with an entry in its column and the other columns with one in its row."""

    row: int
    column: int
    rows: tuple[int, ...]
    columns: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Tearing:
    """The pivots known beforehand, in order, and the rows and columns that are left. Compared by value."""

    steps: tuple[_Step, ...] = ()
    rows: tuple[int, ...] = ()
    columns: tuple[int, ...] = ()

    def describe(self, size: int) -> str:
        """In words, for matrices of this size."""
        left = size - len(self.steps)
        how = "straight-line" if left <= UNROLLED else "in a loop over columns" if left <= LOOPED else "by LAPACK"
        core = f"{left} with pivoting, {how}" if left else "none needs pivoting"
        return f"{size} × {size}: {len(self.steps)} unknowns eliminated by structure, {core}"

    def solve(self, a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
        """x with A x = b; infinities or NaN for a singular A."""
        if not self.steps:
            return solve(a, b)
        core, right, rest = subroutine(scalarise(self._reduced))(a, b)
        return subroutine(scalarise(self._completed))(solve(core, right) if self.rows else right, rest)

    def _reduced(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """The core, its right-hand side, and of each step (right-hand side, entries of its row) over the pivot."""
        entries, right, rest = {}, list(b), []
        entry = lambda i, k: entries[i, k] if (i, k) in entries else a[i, k]
        for step in self.steps:
            pivot = entry(step.row, step.column)
            scaled = [entry(step.row, k) / pivot for k in step.columns]
            ahead = right[step.row] / pivot
            for i in step.rows:
                factor = entry(i, step.column)
                right[i] = right[i] - factor * ahead
                for k, value in zip(step.columns, scaled, strict=True):
                    entries[i, k] = entry(i, k) - factor * value
            rest += [ahead, *scaled]
        core = [entry(i, k) for i in self.rows for k in self.columns]
        size = len(self.rows)
        stacked = lambda values, shape: jnp.stack(values).reshape(shape) if values else jnp.zeros(shape, a.dtype)
        return stacked(core, (size, size)), stacked([right[i] for i in self.rows], (size,)), jnp.stack(rest)

    def _completed(self, core: Array, rest: Array) -> Array:
        x = dict(zip(self.columns, core, strict=True))
        end = len(rest)
        for step in reversed(self.steps):
            start = end - 1 - len(step.columns)
            x[step.column] = rest[start] - sum(rest[start + 1 + k] * x[j] for k, j in enumerate(step.columns))
            end = start
        return jnp.stack([x[j] for j in range(len(x))])


def tearing(known: Float[np.ndarray, "n n"]) -> Tearing:
    """The pivots of matrices with these entries, NaN where an entry is no known number, in the order of least fill."""
    matrix, rows, columns = known.copy(), np.ones(len(known), bool), np.ones(len(known), bool)
    steps: list[_Step] = []
    products = 0
    while candidates := _candidates(matrix, rows, columns) if len(known) <= LOOPED else []:
        step = min(candidates, key=lambda step: len(step.rows) * len(step.columns))
        products += (len(step.rows) + 1) * (len(step.columns) + 1)
        if products > MOST:
            break
        steps.append(step)
        rows[step.row] = columns[step.column] = False
        changed = np.ix_(step.rows, step.columns)
        change = (
            matrix[step.rows, step.column][:, None] * matrix[step.row, step.columns] / matrix[step.row, step.column]
        )
        # What is left of numbers that cancel is none.
        noise = 1e-12 * (np.abs(matrix[changed]) + np.abs(change))
        new = matrix[changed] - change
        matrix[changed] = np.where(np.abs(new) <= noise, 0, new)
    return Tearing(tuple(steps), tuple(map(int, np.flatnonzero(rows))), tuple(map(int, np.flatnonzero(columns))))


def _candidates(matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> list[_Step]:
    found = []
    for i, j in np.argwhere((matrix != 0) & rows[:, None] & columns):
        below = [int(r) for r in np.flatnonzero((matrix[:, j] != 0) & rows) if r != i]
        across = [int(k) for k in np.flatnonzero((matrix[i] != 0) & columns) if k != j]
        # A NaN compares false.
        size = np.abs(matrix[i, j])
        if (
            not (below and across)
            or np.all(np.abs(matrix[below, j]) <= size)
            or np.all(np.abs(matrix[i, across]) <= size)
        ):
            found.append(_Step(int(i), int(j), tuple(below), tuple(across)))
    return found
