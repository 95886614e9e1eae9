"""Colouring: the columns of a sparse Jacobian that one directional derivative can find at once."""

import heapq

import numpy as np
from jaxtyping import Bool, Float, Int


def column_colouring(pattern: Bool[np.ndarray, "m n"]) -> Int[np.ndarray, " n"]:
    """A colour 0, 1, ... for each column, such that columns of one colour have no nonzero row in common.

    Greedy, in the order given and in smallest-last order, whichever needs fewer; a chain gets as many colours as its
    fullest row has nonzeros, the least there can be. With the 0-1 matrix S of `seed_matrix`, the compressed Jacobian
    J S (one directional derivative a colour) holds every nonzero: J[i, j] = (J S)[i, colours[j]]. An empty column has
    colour 0.

    Source: A. H. Gebremedhin, F. Manne, A. Pothen, What color is your Jacobian?, SIAM Review 47 (2005), sections 3, 7.
    """
    neighbours = _column_intersection_graph(
        np.asarray(pattern.toarray() if hasattr(pattern, "toarray") else pattern, bool)
    )
    orders = [list(range(len(neighbours))), _smallest_first(neighbours)[::-1]]
    return min((_greedy(neighbours, order) for order in orders), key=lambda colours: colours.max(initial=-1))


def seed_matrix(colours: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n colours"]:
    """S with S[j, colours[j]] = 1: the directions of the derivatives that compress a Jacobian."""
    return (colours[:, None] == np.arange(colours.max(initial=-1) + 1)).astype(float)


def _column_intersection_graph(pattern: np.ndarray) -> list[set[int]]:
    """For each column the others with which it shares a nonzero row."""
    columns_of = [np.flatnonzero(row).tolist() for row in pattern]
    return [
        {other for row in np.flatnonzero(column) for other in columns_of[row]} - {j}
        for j, column in enumerate(pattern.T)
    ]


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
