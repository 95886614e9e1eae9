"""Patterns: which entries of a matrix may be other than 0."""

import itertools
from typing import cast

import numpy as np
from jaxtyping import Bool
from scipy.sparse import csr_array


# A sparse matrix of truth values, or a dense one.
Pattern = csr_array | Bool[np.ndarray, "m n"]


def shape_of(pattern: Pattern) -> tuple[int, int]:
    """Its rows and columns, which scipy's types take for an option."""
    return cast("tuple[int, int]", pattern.shape)


def variables_of(pattern: csr_array) -> list[list[int]]:
    """The columns in which each row has an entry."""
    columns, ends = (list(map(int, x)) for x in (pattern.indices, pattern.indptr))
    return [columns[low:high] for low, high in itertools.pairwise(ends)]


def signature(*patterns: Pattern) -> list[dict[int, int]]:
    """For each equation its variables with their highest derivative, from the patterns of shape (equations, variables)
    with respect to the variables themselves, their first derivatives, their second derivatives, and so on.
    """
    rows: list[dict[int, int]] = [{} for _ in range(shape_of(patterns[0])[0])]
    for order, pattern in enumerate(map(csr_array, patterns)):
        for row, variables in zip(rows, variables_of(pattern), strict=True):
            row.update(dict.fromkeys(variables, order))
    return rows
