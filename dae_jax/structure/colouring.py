"""Colouring: the columns of a sparse Jacobian that one directional derivative can find at once."""

import heapq

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from .patterns import Pattern, shape_of, variables_of


def column_colouring(pattern: Pattern) -> Int[np.ndarray, " n"]:
    """A colour 0, 1, ... for each column, such that columns of one colour have no nonzero row in common.

    Greedy, in the order given and in smallest-last order, whichever needs fewer; a chain gets as many colours as its
    fullest row has nonzeros, the least there can be, and a pattern with a full row one a column. With the 0-1 matrix S of
    `seed_matrix`, the compressed Jacobian J S (one directional derivative a colour) holds every nonzero:
    J[i, j] = (J S)[i, colours[j]]. An empty column has colour 0.

    Source: A. H. Gebremedhin, F. Manne, A. Pothen, What color is your Jacobian?, SIAM Review 47 (2005), sections 3, 7.
    """
    pattern = csr_array(pattern)
    count = shape_of(pattern)[1]
    if np.diff(pattern.indptr).max(initial=0) == count:
        return np.arange(count)
    neighbours = _column_intersection_graph(pattern)
    orders = [list(range(len(neighbours))), _smallest_first(neighbours)[::-1]]
    return min((_greedy(neighbours, order) for order in orders), key=lambda colours: colours.max(initial=-1))


def seed_matrix(colours: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n colours"]:
    """S with S[j, colours[j]] = 1: the directions of the derivatives that compress a Jacobian."""
    return (colours[:, None] == np.arange(colours.max(initial=-1) + 1)).astype(float)


def _column_intersection_graph(pattern: csr_array) -> list[set[int]]:
    """For each column the others with which it shares a nonzero row."""
    columns_of, rows_of = variables_of(pattern), variables_of(pattern.T.tocsr())
    return [{other for row in rows for other in columns_of[row]} - {j} for j, rows in enumerate(rows_of)]


def _greedy(neighbours: list[set[int]], order: list[int]) -> np.ndarray:
    """Each vertex in turn with the first colour that no neighbour has."""
    colours = [-1] * len(neighbours)
    for vertex in order:
        taken = {colours[other] for other in neighbours[vertex]}
        colours[vertex] = next(colour for colour in range(len(taken) + 1) if colour not in taken)
    return np.array(colours, int)


def _smallest_first(neighbours: list[set[int]]) -> list[int]:
    """The vertices in the order in which one with the fewest remaining neighbours is taken away."""
    degrees = [len(others) for others in neighbours]
    heap = [(degree, vertex) for vertex, degree in enumerate(degrees)]
    heapq.heapify(heap)
    order, taken = [], set[int]()
    while heap:
        degree, vertex = heapq.heappop(heap)
        if vertex in taken or degree != degrees[vertex]:
            continue
        taken.add(vertex)
        order.append(vertex)
        for other in neighbours[vertex] - taken:
            degrees[other] -= 1
            heapq.heappush(heap, (degrees[other], other))
    return order
