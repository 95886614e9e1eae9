"""Pantelides' algorithm: which equations must be differentiated, and how often, before a DAE can be solved.

The system is 0 = F_i(t, the x_j and their derivatives). Of it only the signature is seen: for each equation i, the
highest derivative σ_ij of each variable j that occurs in it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .matching import alternating_reach, maximum_matching, require_nonsingular


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
    number of equations unless given. Equations are paired among the highest derivatives only, σ_ij + c_i = d_j, as many as can
    be; those that are left, and all equations and variables that alternating paths reach from them, are differentiated once
    more, which keeps the pairs made so far. What is found does not depend on the order in which that is done. Raises
    `StructurallySingular` for a system on which this would not end.

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

    highest = _HighestDerivatives(signature, offsets, orders)
    matching = maximum_matching(highest, n_variables)
    while unpaired := [equation for equation, variable in enumerate(matching) if variable is None]:
        equation_of: list[int | None] = [None] * n_variables
        for equation, variable in enumerate(matching):
            if variable is not None:
                equation_of[variable] = equation
        equations, variables = alternating_reach(unpaired, highest, equation_of)
        for equation in equations:
            offsets[equation] += 1
        for variable in variables:
            orders[variable] += 1
        matching = maximum_matching(highest, n_variables, matching)
    return Pantelides(tuple(offsets), tuple(orders), tuple(j for j in matching if j is not None))


class _HighestDerivatives(Sequence[list[int]]):
    """For each equation, differentiated as often as now, the variables whose highest derivative is in it."""

    def __init__(self, signature: Sequence[Mapping[int, int]], offsets: list[int], orders: list[int]) -> None:
        self.signature, self.offsets, self.orders = signature, offsets, orders

    def __len__(self) -> int:
        return len(self.signature)

    def __getitem__(self, i: int) -> list[int]:  # type: ignore[override]
        offset = self.offsets[i]
        return [j for j, order in self.signature[i].items() if order + offset == self.orders[j]]
