"""The order in which a sparse matrix is eliminated, and which entries its factors have: found once, without numbers.

Equations and unknowns are paired before, each pair is eliminated by its own pivot, and what is looked for is an order of the
pairs with little fill.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int


# By how much diagonal entries exceed the others of their row together, where an elimination with numbers finds the pattern: more,
# and fill far from the diagonal would underflow.
DOMINANCE = 1e-6
# So many rows of one pattern are subtracted at once, which reads and writes what is left of a row once in place of as often.
TOGETHER = 4


class SymbolicLU(NamedTuple):
    """L U = P A Q of n unknowns by rows: L below the diagonal without its ones, U from there on. An argument of the kernels that
    find and use the factors: one kernel serves all patterns of a size.

    `rows`, `columns`: which of A stand where; `start`, `diagonal`, `at`: where each row begins and has its diagonal, and the
    columns of its entries; `given_start`, `given`, `given_at`: the same of the entries of A, with their numbers. Entries of L are
    taken one after the other or, where they stand beside each other and belong to rows of U of one pattern, by `TOGETHER`:
    `group_start`, `group`, `is_many`: where the groups of each row begin, the first entry of each, whether it is one of so many.
    """

    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " n+1"]
    diagonal: Int[np.ndarray, " n"]
    at: Int[np.ndarray, " filled"]
    given_start: Int[np.ndarray, " n+1"]
    given: Int[np.ndarray, " entries"]
    given_at: Int[np.ndarray, " entries"]
    group_start: Int[np.ndarray, " n+1"]
    group: Int[np.ndarray, " groups"]
    is_many: Int[np.ndarray, " groups"]

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return len(self.rows)

    @property
    def cost(self) -> int:
        """Multiplications of a factorisation."""
        after = self.start[1:] - self.diagonal - 1
        row = np.repeat(np.arange(self.size), np.diff(self.start))
        return int(after[self.at[self.at < row]].sum())


def symbolic_lu(
    rows: Int[np.ndarray, " entries"], columns: Int[np.ndarray, " entries"], pairing: Int[np.ndarray, " n"]
) -> SymbolicLU:
    """The order and the fill of the matrix with entries at (`rows`, `columns`), with pivots at (i, `pairing`[i])."""
    n = len(pairing)
    paired = pairing[rows]
    position, start, at = filled(paired, columns, n)
    variables = np.argsort(position)
    at_row, at_column = position[paired], position[columns]
    given = np.lexsort((at_column, at_row))
    diagonal = np.flatnonzero(np.repeat(np.arange(n), np.diff(start)) == at)
    indices = (
        np.argsort(pairing)[variables],
        variables,
        start,
        diagonal,
        at,
        np.searchsorted(at_row[given], np.arange(n + 1)),
        given,
        at_column[given],
        *_groups(start, diagonal, at),
    )
    return SymbolicLU(*(x.astype(np.uint32) for x in indices))


def filled(
    rows: Int[np.ndarray, " entries"], columns: Int[np.ndarray, " entries"], n: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n+1"], Int[np.ndarray, " filled"]]:
    """Of n pivots on the diagonal: which position each takes, and the pattern of L + U in that order, where rows start and the
    columns of their entries.

    By minimum degree on the pattern of A + Aᵀ. SuperLU orders, and eliminates, an M-matrix of this pattern: fill only adds negative
    numbers there, so that what is not 0 in its factors is the fill.

    Source: J. W. H. Liu, Modification of the minimum-degree algorithm by multiple elimination, ACM Trans. Math. Softw. 11
    (1985); X. S. Li, An overview of SuperLU, ACM Trans. Math. Softw. 31 (2005).
    """
    from scipy.sparse import csc_array, csr_array, diags_array
    from scipy.sparse.linalg import splu

    pattern = csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    both = csr_array(pattern + pattern.T)
    both.setdiag(0)
    both.eliminate_zeros()
    both.data[:] = 1
    m_matrix = csc_array(diags_array((1 + DOMINANCE) * np.maximum(both.sum(1), 1)) - both)
    factors = splu(m_matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    found = csr_array(csr_array(factors.L != 0) + csr_array(factors.U != 0))
    found.sort_indices()
    if not np.array_equal(factors.perm_c, factors.perm_r):
        raise AssertionError("An elimination along the diagonal left it.")
    return factors.perm_c, found.indptr, found.indices


def _groups(
    start: Int[np.ndarray, " n+1"], diagonal: Int[np.ndarray, " n"], at: Int[np.ndarray, " filled"]
) -> tuple[Int[np.ndarray, " n+1"], Int[np.ndarray, " groups"], Int[np.ndarray, " groups"]]:
    """The groups of the entries of L: where those of each row begin, their first entries, and whether they are of `TOGETHER`."""
    n, more = len(diagonal), TOGETHER - 1
    entries = np.concatenate([at, np.full(more, -1)])
    # Of row k and the next ones each has the pattern of the last, and the columns before: as many entries as fit.
    first = np.arange(max(n - more, 0))
    after = start[1:] - diagonal
    alike = np.zeros(n, bool)
    alike[first] = (after[first] == after[first + more] + more) & (entries[diagonal[first] + more] == first + more)
    whole = alike[at] & (entries[np.arange(len(at)) + more] == at + more)
    group_start, group, many = [0], [], []
    for p, end in zip(start[:-1].tolist(), diagonal.tolist(), strict=True):
        while p < end:
            group.append(p)
            many.append(bool(whole[p]) and p + more < end)
            p += TOGETHER if many[-1] else 1
        group_start.append(len(group))
    # One more, as nothing can be read from an array of none.
    return np.array(group_start), np.array([*group, 0]), np.array([*many, False])
