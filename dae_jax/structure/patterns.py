"""Patterns: which entries of a matrix may be other than 0."""

import itertools

import numpy as np
from jaxtyping import Bool
from scipy.sparse import csr_array


# A sparse matrix of truth values, or a dense one.
Pattern = csr_array | Bool[np.ndarray, "m n"]


def variables_of(pattern: csr_array) -> list[list[int]]:
    """The columns in which each row has an entry."""
    columns, ends = pattern.indices.tolist(), pattern.indptr.tolist()
    return [columns[low:high] for low, high in itertools.pairwise(ends)]


def signature(*patterns: Pattern) -> list[dict[int, int]]:
    """For each equation its variables with their highest derivative, from the patterns of shape (equations, variables)
    with respect to the variables themselves, their first derivatives, their second derivatives, and so on.
    """
    rows: list[dict[int, int]] = [{} for _ in range(patterns[0].shape[0])]
    for order, pattern in enumerate(map(csr_array, patterns)):
        for row, variables in zip(rows, variables_of(pattern), strict=True):
            row.update(dict.fromkeys(variables, order))
    return rows
