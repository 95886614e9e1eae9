"""The order in which a sparse symmetric matrix is eliminated along its diagonal, and which entries its factor has."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from .symbolic_lu import filled


# So many rows of one pattern are subtracted at once, which reads and writes what is left of a row once in place of as often.
TOGETHER = 4


class SymbolicLDL(NamedTuple):
    """Uᵀ D⁻¹ U = P S Pᵀ of n unknowns, U by rows from their diagonal D on. An argument of the kernels that find and use the factor:
    one kernel serves all patterns of a size.

    `order`: which unknowns of S stand where; `start`, `at`: where each row begins, and the columns of its entries; `given`: the
    numbers of these entries in S, one more than there are for fill. Row k is left of that of S when rows i < k that have column k are
    subtracted: alone, or `TOGETHER` that follow each other and have one pattern. Of each such set its first row i and the place of
    its entry (i, k): `alone_start`, `alone_row`, `alone`; `many_start`, `many_row`, `many`.
    """

    order: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " n+1"]
    at: Int[np.ndarray, " filled"]
    given: Int[np.ndarray, " filled"]
    alone_start: Int[np.ndarray, " n+1"]
    alone_row: Int[np.ndarray, " sets"]
    alone: Int[np.ndarray, " sets"]
    many_start: Int[np.ndarray, " n+1"]
    many_row: Int[np.ndarray, " many"]
    many: Int[np.ndarray, " many"]

    @property
    def cost(self) -> int:
        """Multiplications of a factorisation."""
        after = np.diff(self.start.astype(int)) - 1
        return int((after * (after + 1) // 2).sum())


def symbolic_ldl(n: int, rows: Int[np.ndarray, " c"], columns: Int[np.ndarray, " c"]) -> SymbolicLDL:
    """The order and the fill of the matrix with the diagonal, and entries at (`rows`, `columns`) and (`columns`, `rows`), numbered
    so.
    """
    position, both_start, both_at = filled(
        np.concatenate([np.arange(n), rows]), np.concatenate([np.arange(n), columns]), n
    )
    row = np.repeat(np.arange(n), np.diff(both_start))
    row, at = row[row <= both_at], both_at[row <= both_at]
    start = np.searchsorted(row, np.arange(n + 1))
    # Entries are in the order of these keys.
    first, second = np.sort([position[rows], position[columns]], 0)
    keys = n * np.concatenate([position, first]) + np.concatenate([position, second])
    given = np.full(len(at), n + len(rows))
    given[np.searchsorted(n * row + at, keys)] = np.arange(len(keys))
    indices = np.argsort(position), start, at, given, *_sets(start, row, at)
    return SymbolicLDL(*(x.astype(np.uint32) for x in indices))


def _sets(
    start: Int[np.ndarray, " n+1"], row: Int[np.ndarray, " filled"], at: Int[np.ndarray, " filled"]
) -> list[Int[np.ndarray, "..."]]:
    """Of each row which rows are subtracted alone and which together: where those of it begin, the first rows, and their entries."""
    n = len(start) - 1
    grouped = np.full(n, -1)
    i = 0
    while i < n:
        j = i + TOGETHER - 1
        # The last of them has the pattern of the first but for the columns of those before.
        if (
            j < n
            and at[start[i] + TOGETHER - 1] == j
            and start[i + 1] - start[i] == start[j + 1] - start[j] + TOGETHER - 1
        ):
            grouped[i : j + 1] = np.arange(TOGETHER)
            i = j
        i += 1
    # Rows of a set are subtracted from each other alone.
    own = np.arange(len(at)) - start[row]
    together = (grouped[row] >= 0) & (own > TOGETHER - 1 - grouped[row])
    found = []
    for places in (np.flatnonzero(~together & (own > 0)), np.flatnonzero(together & (grouped[row] == 0))):
        places = places[np.argsort(at[places], kind="stable")]
        begin = np.searchsorted(at[places], np.arange(n + 1))
        # One more, as nothing can be read from an array of none.
        found += [begin, np.append(row[places], 0), np.append(places, 0)]
    return found
