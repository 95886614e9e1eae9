"""Pantelides' algorithm: which equations must be differentiated, and how often, before a DAE can be solved.

The system is 0 = F_i(t, the x_j and their derivatives). Of it only the signature is seen: for each equation i, the
highest derivative σ_ij of each variable j that occurs in it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .matching import require_nonsingular


class Pantelides(NamedTuple):
    """What Pantelides' algorithm finds.

    **Attributes**

    - `equation_offsets`: c, how often each equation is differentiated.
    - `variable_orders`: d, the highest derivative of each variable in the differentiated system.
    - `matching`: the variable whose derivative of order d each differentiated equation is to be solved for.
    """

    equation_offsets: tuple[int, ...]
    variable_orders: tuple[int, ...]
    matching: tuple[int, ...]


def pantelides(signature: Sequence[Mapping[int, int]], n_variables: int | None = None) -> Pantelides:
    """Differentiates the fewest equations until the highest derivatives can be paired with the equations.

    `signature[i]` maps each variable of equation i to the order of its highest derivative there. `n_variables` is the
    number of equations unless given. Equations are paired one after the other by augmenting paths among the highest
    derivatives only; where no path exists, the equations and variables that the search reached are differentiated once
    more, which keeps the pairs made so far. Raises `StructurallySingular` for a system on which this would not end.

    Source: C. C. Pantelides, The consistent initialization of differential-algebraic systems, SIAM J. Sci. Stat.
    Comput. 9 (1988), algorithm 3.1.
    """
    n_variables = len(signature) if n_variables is None else n_variables
    require_nonsingular(signature, n_variables)
    offsets = [0] * len(signature)
    orders = [0] * n_variables
    for row in signature:
        for variable, order in row.items():
            orders[variable] = max(orders[variable], order)

    equation_of: list[int | None] = [None] * n_variables
    variable_of = [-1] * len(signature)
    for start in range(len(signature)):
        free, equations, reached_from = _search(start, signature, offsets, orders, equation_of)
        while free is None:
            for equation in equations:
                offsets[equation] += 1
            for variable in reached_from:
                orders[variable] += 1
            free, equations, reached_from = _search(start, signature, offsets, orders, equation_of)
        while free != -1:
            equation = reached_from[free]
            equation_of[free], variable_of[equation], free = equation, free, variable_of[equation]
    return Pantelides(tuple(offsets), tuple(orders), tuple(variable_of))


def _search(
    start: int,
    signature: Sequence[Mapping[int, int]],
    offsets: Sequence[int],
    orders: Sequence[int],
    equation_of: Sequence[int | None],
) -> tuple[int | None, list[int], dict[int, int]]:
    """Searches an augmenting path from equation `start` through highest derivatives, σ_ij + c_i = d_j.

    Gives the free variable at its end or `None`, the equations reached, and for each variable reached the equation
    that it was reached from.
    """
    reached_from: dict[int, int] = {}
    equations = [start]
    for equation in equations:
        offset = offsets[equation]
        for variable, order in signature[equation].items():
            if order + offset != orders[variable] or variable in reached_from:
                continue
            reached_from[variable] = equation
            owner = equation_of[variable]
            if owner is None:
                return variable, equations, reached_from
            equations.append(owner)
    return None, equations, reached_from
