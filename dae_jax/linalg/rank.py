"""Whether a sparse matrix is nonsingular to round-off."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from ..structure import Block


# Larger blocks are factorised by sparse elimination.
DENSE = 300


def is_nonsingular(matrix: csr_array, blocks: Sequence[Block], eps: float) -> bool:
    """Whether all blocks of a matrix in block triangular form are, its rows scaled to a greatest entry of 1.

    By singular values; of large blocks by LU factorisation and an estimate of the condition in the 1-norm. `eps`: the
    round-off of the entries.

    Source: N. J. Higham, F. Tisseur, A block algorithm for matrix 1-norm estimation, SIAM J. Matrix Anal. Appl. 21 (2000).
    """
    rows = abs(matrix).max(1).toarray().reshape(-1)
    if not (np.isfinite(matrix.data).all() and (rows > 0).all()):
        return False
    scaled = csr_array(diags_array(1 / rows) @ matrix)
    sizes = np.array([len(block.equations) for block in blocks])
    values = [np.zeros(0)]
    for size in np.unique(sizes[sizes <= DENSE]):
        of_size = [blocks[int(k)] for k in np.flatnonzero(sizes == size)]
        values.append(_singular_values(scaled, of_size, len(rows)))
    found = np.concatenate(values)
    if found.min(initial=1) <= 100 * len(rows) * eps * found.max(initial=0):
        return False
    large = [block for block in blocks if len(block.equations) > DENSE]
    return all(_condition(scaled[list(block.equations)][:, list(block.variables)]) < 1e-3 / eps for block in large)


def _singular_values(matrix: csr_array, blocks: Sequence[Block], count: int) -> np.ndarray:
    """Of the blocks, which are of one size, of a matrix with `count` columns."""
    equations, variables = (np.array(part) for part in zip(*blocks, strict=True))
    block_of, place_of = np.full(count, -1), np.zeros(count, int)
    block_of[variables], place_of[variables] = np.indices(variables.shape)
    part = matrix[equations.reshape(-1)].tocoo()
    block, row = np.divmod(part.row, variables.shape[1])
    own = block_of[part.col] == block
    dense = np.zeros((*variables.shape, variables.shape[1]))
    dense[block[own], row[own], place_of[part.col[own]]] = part.data[own]
    return np.linalg.svd(dense, compute_uv=False).reshape(-1)


def _condition(matrix: csr_array) -> float:
    """An estimate of ‖A‖₁ ‖A⁻¹‖₁, infinite for a singular matrix."""
    # A fifth of what importing the library would take beyond diffrax.
    from scipy.sparse.linalg import LinearOperator, onenormest, splu

    try:
        factors = splu(matrix.tocsc())
    except RuntimeError:
        return np.inf
    transposed = lambda x: factors.solve(x, "T")
    # One of functions, of which scipy's types know nothing.
    operator: Any = LinearOperator
    inverse = operator(factors.shape, factors.solve, transposed, matmat=factors.solve, rmatmat=transposed, dtype=float)
    return float(abs(matrix).sum(0).max() * onenormest(inverse))
