"""Pryce's Σ-method: the structure of a DAE from an assignment problem.

With σ_ij the highest derivative of variable j in equation i (−∞ where it does not occur), a highest-value transversal
pairs equations with variables so that Σ σ_ij is greatest. Its dual gives the offsets: the smallest c_i ≥ 0 and d_j with

    d_j − c_i ≥ σ_ij,  with equality on the transversal.

Differentiating equation i c_i times yields, where the system Jacobian ∂F_i/∂x_j^(σ_ij) (entries with d_j − c_i = σ_ij)
is nonsingular, every x_j^(d_j) in terms of lower derivatives.

Source: J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001).
"""

import heapq
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .blocks import block_triangular
from .matching import maximum_matching, require_nonsingular


class SigmaAnalysis(NamedTuple):
    """What the Σ-method finds.

    **Attributes**

    - `equation_offsets`, `variable_offsets`: the canonical (smallest) c and d.
    - `transversal`: the variable that each equation is paired with.
    - `degrees_of_freedom`: Val(Σ) = Σ d − Σ c, the number of initial values that can be chosen.
    - `index`: the structural index, max c + 1 if some d_j = 0, else max c. An upper bound of the differential index
      where the system Jacobian is nonsingular.
    """

    equation_offsets: tuple[int, ...]
    variable_offsets: tuple[int, ...]
    transversal: tuple[int, ...]
    degrees_of_freedom: int
    index: int


def sigma_method(signature: Sequence[Mapping[int, int]], n_variables: int | None = None) -> SigmaAnalysis:
    """The Σ-method on `signature`: for each equation, a map from each of its variables to its highest derivative.

    `n_variables` is the number of equations unless given. Raises `StructurallySingular` where there is no transversal.
    """
    n_variables = len(signature) if n_variables is None else n_variables
    require_nonsingular(signature, n_variables)
    transversal = highest_value_transversal(signature)
    c, d = canonical_offsets(signature, transversal)
    index = max(c, default=0) + (1 if 0 in d else 0)
    return SigmaAnalysis(tuple(c), tuple(d), tuple(transversal), sum(d) - sum(c), index)


def highest_value_transversal(signature: Sequence[Mapping[int, int]]) -> list[int]:
    """The variable of each equation in a pairing with the greatest Σ σ_ij, of a structurally nonsingular system.

    As many as can be are paired among the highest derivatives of the variables; the others join one by one along a shortest
    augmenting path in the reduced costs u_i + v_j − σ_ij ≥ 0; O(n · entries · log n) at worst.

    Source: R. Jonker, A. Volgenant, A shortest augmenting path algorithm for dense and sparse linear assignment
    problems, Computing 38 (1987).
    """
    n = len(signature)
    v = [0] * n
    for row in signature:
        for variable, order in row.items():
            v[variable] = max(v[variable], order)
    u = [max(order - v[variable] for variable, order in row.items()) for row in signature]
    cheapest = [[j for j, order in row.items() if u[i] + v[j] == order] for i, row in enumerate(signature)]
    paired = maximum_matching(cheapest, n)
    equation_of = [-1] * n
    variable_of = [-1 if variable is None else variable for variable in paired]
    for equation, variable in enumerate(variable_of):
        if variable != -1:
            equation_of[variable] = equation
    for start in [equation for equation, variable in enumerate(paired) if variable is None]:
        distance: dict[int, int] = {}
        reached_from: dict[int, int] = {}
        settled: dict[int, int] = {}
        heap: list[tuple[int, bool, int]] = []
        equation, travelled = start, 0
        while True:
            for variable, order in signature[equation].items():
                if variable in settled:
                    continue
                new = travelled + u[equation] + v[variable] - order
                if new < distance.get(variable, new + 1):
                    distance[variable], reached_from[variable] = new, equation
                    heapq.heappush(heap, (new, equation_of[variable] != -1, variable))
            travelled, _, variable = heapq.heappop(heap)
            while variable in settled:
                travelled, _, variable = heapq.heappop(heap)
            settled[variable] = travelled
            equation = equation_of[variable]
            if equation == -1:
                break
        u[start] -= travelled
        for other, reached_at in settled.items():
            v[other] += travelled - reached_at
            if other != variable:
                u[equation_of[other]] -= travelled - reached_at
        while variable != -1:
            equation = reached_from[variable]
            equation_of[variable], variable_of[equation], variable = equation, variable, variable_of[equation]
    return variable_of


def canonical_offsets(
    signature: Sequence[Mapping[int, int]], transversal: Sequence[int]
) -> tuple[list[int], list[int]]:
    """The smallest offsets c, d of a highest-value transversal, by Pryce's fixed-point iteration

        d_j ← max_i (σ_ij + c_i),    c_i ← d_j(i) − σ_i,j(i),    from c = 0.

    Only equations whose offset grew are looked at again. Ends if and only if the transversal has the highest value.
    """
    c = [0] * len(signature)
    d = [0] * len(signature)
    equation_of = {variable: equation for equation, variable in enumerate(transversal)}
    changed = set(range(len(signature)))
    while changed:
        raised = set()
        for equation in changed:
            for variable, order in signature[equation].items():
                if order + c[equation] > d[variable]:
                    d[variable] = order + c[equation]
                    raised.add(variable)
        changed = set()
        for variable in raised:
            equation = equation_of[variable]
            offset = d[variable] - signature[equation][variable]
            if offset > c[equation]:
                c[equation] = offset
                changed.add(equation)
    return c, d


def jacobian_pattern(
    signature: Sequence[Mapping[int, int]], equation_offsets: Sequence[int], variable_offsets: Sequence[int]
) -> list[list[int]]:
    """The variables j of each equation i with σ_ij = d_j − c_i: the nonzeros of the system Jacobian."""
    return [
        [variable for variable, order in row.items() if variable_offsets[variable] - offset == order]
        for row, offset in zip(signature, equation_offsets, strict=True)
    ]


def variable_indices(
    pattern: Sequence[Sequence[int]],
    transversal: Sequence[int],
    equation_offsets: Sequence[int],
    variable_offsets: Sequence[int],
) -> tuple[int, ...]:
    """The index of each variable, from the pattern of the system Jacobian: 1 + max cᵢ − dⱼ, over the equations i that
    determine it. The greatest bounds the differential index.

    Those are the equations of its block of the system Jacobian's block triangular form, and of the blocks before on
    which they depend. A mechanism's q, v and λ have the indices 1, 2 and 3; a variable that a differential equation of
    its own determines has 0. Errors of a variable of index k grow like h^(1−k) in a step.

    Source: E. Hairer, C. Lubich, M. Roche, *The Numerical Solution of Differential-Algebraic Systems by Runge–Kutta
    Methods*, section 1, for the notion; the formula follows from the offsets.
    """
    highest = [0] * len(pattern)
    indices = [0] * len(pattern)
    for block in block_triangular(pattern, transversal):
        before = {variable for equation in block.equations for variable in pattern[equation]} - set(block.variables)
        top = max([*(equation_offsets[i] for i in block.equations), *(highest[variable] for variable in before)])
        for variable in block.variables:
            highest[variable] = top
            indices[variable] = max(1 + top - variable_offsets[variable], 0)
    return tuple(indices)
