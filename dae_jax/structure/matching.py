"""Which equation determines which variable: maximum matchings of the graph between equations and variables.

A matching pairs equations with variables that occur in them, each at most once. A square system is structurally
nonsingular when all are paired; otherwise the Dulmage–Mendelsohn decomposition says which part has too many equations
and which too many variables.
"""

import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple


# A sentence names so many equations or variables.
NAMED = 8


class StructurallySingular(ValueError):
    """No choice of numbers makes the system regular: some equations or variables cannot be paired.

    **Attributes**

    - `equations`: the over-determined part; these equations have fewer variables than they number.
    - `variables`: the under-determined part; these variables have fewer equations than they number.
    """

    def __init__(self, equations: Iterable[int], variables: Iterable[int]) -> None:
        self.equations = tuple(sorted(equations))
        self.variables = tuple(sorted(variables))
        numbers = (f"[{in_short(places)}]" if places else "" for places in (self.equations, self.variables))
        super().__init__(self.sentence(*numbers))

    @staticmethod
    def sentence(equations: str, variables: str) -> str:
        """What is singular, in words for the equations and the variables, empty where there are none."""
        parts = []
        if equations:
            parts.append(f"the equations {equations} have too few variables between them")
        if variables:
            parts.append(f"the variables {variables} have too few equations between them")
        redundant = " Redundant equations, such as constraints that follow from others, do that." if equations else ""
        return f"The system is structurally singular: {'; '.join(parts)}.{redundant}"


def in_short(names: Collection[object]) -> str:
    """The first few of them, and how many more there are."""
    first = ", ".join(map(str, itertools.islice(names, NAMED)))
    return f"{first} and {len(names) - NAMED} more" if len(names) > NAMED else first


class CoarseDecomposition(NamedTuple):
    """The Dulmage–Mendelsohn parts of a system: over-determined, under-determined, and the rest, which is regular.

    Every over-determined equation has its variables in `over_variables` alone; every under-determined variable occurs
    in `under_equations` alone.
    """

    over_equations: tuple[int, ...]
    over_variables: tuple[int, ...]
    under_equations: tuple[int, ...]
    under_variables: tuple[int, ...]
    regular_equations: tuple[int, ...]
    regular_variables: tuple[int, ...]


def maximum_matching(
    incidence: Sequence[Collection[int]], n_variables: int, start: Sequence[int | None] = ()
) -> list[int | None]:
    """The variable that each equation is paired with in a matching of greatest size; `None` if unpaired.

    `incidence[i]` holds the variables of equation i; `start` is a matching to begin with, whose equations stay paired. In
    phases, each of which finds as many disjoint shortest augmenting paths as there are room for: O(entries · √equations).

    Source: J. E. Hopcroft, R. M. Karp, An n^(5/2) algorithm for maximum matchings in bipartite graphs, SIAM J. Comput. 2
    (1973).
    """
    variable_of: list[int | None] = list(start) or [None] * len(incidence)
    equation_of: list[int | None] = [None] * n_variables
    for equation, variable in enumerate(variable_of):
        if variable is not None:
            equation_of[variable] = equation
    for equation, variable in enumerate(variable_of):
        if variable is None:
            free = next((j for j in incidence[equation] if equation_of[j] is None), None)
            if free is not None:
                equation_of[free], variable_of[equation] = equation, free
    while depth := _layers(incidence, equation_of, variable_of):
        _augment(incidence, equation_of, variable_of, depth)
    return variable_of


def _layers(
    incidence: Sequence[Collection[int]], equation_of: list[int | None], variable_of: list[int | None]
) -> dict[int, int]:
    """How far from an unpaired equation alternating paths reach the others, as far as the nearest unpaired variable; empty where
    none is reached.
    """
    queue = [equation for equation, variable in enumerate(variable_of) if variable is None]
    depth = dict.fromkeys(queue, 0)
    last = len(incidence)
    for equation in queue:
        if depth[equation] > last:
            break
        for variable in incidence[equation]:
            owner = equation_of[variable]
            if owner is None:
                last = depth[equation]
            elif owner not in depth:
                depth[owner] = depth[equation] + 1
                queue.append(owner)
    return depth if last < len(incidence) else {}


def _augment(
    incidence: Sequence[Collection[int]],
    equation_of: list[int | None],
    variable_of: list[int | None],
    depth: dict[int, int],
) -> None:
    """Pairs along disjoint paths from layer to layer."""
    rest: dict[int, Iterator[int]] = {}
    for root in [equation for equation, layer in depth.items() if layer == 0]:
        path, through = [root], list[int]()
        while path:
            equation = path[-1]
            for variable in rest.setdefault(equation, iter(incidence[equation])):
                owner = equation_of[variable]
                if owner is None or depth.get(owner) == depth[equation] + 1:
                    through.append(variable)
                    break
            else:
                # A dead end: back by one.
                depth.pop(path.pop())
                if through:
                    through.pop()
                continue
            if owner is not None:
                path.append(owner)
                continue
            for equation, variable in zip(path, through, strict=True):
                equation_of[variable], variable_of[equation] = equation, variable
                depth.pop(equation)
            break


def coarse_decomposition(incidence: Sequence[Collection[int]], n_variables: int) -> CoarseDecomposition:
    """The over-, under- and well-determined parts of a system, whatever its shape.

    Source: A. L. Dulmage, N. S. Mendelsohn, Coverings of bipartite graphs, Canad. J. Math. 10 (1958).
    """
    variable_of = maximum_matching(incidence, n_variables)
    equation_of: list[int | None] = [None] * n_variables
    for equation, variable in enumerate(variable_of):
        if variable is not None:
            equation_of[variable] = equation
    occurs_in: list[list[int]] = [[] for _ in range(n_variables)]
    for equation, variables in enumerate(incidence):
        for variable in variables:
            occurs_in[variable].append(equation)

    unpaired_equations = [i for i, variable in enumerate(variable_of) if variable is None]
    unpaired_variables = [j for j, equation in enumerate(equation_of) if equation is None]
    over_equations, over_variables = alternating_reach(unpaired_equations, incidence, equation_of)
    under_variables, under_equations = alternating_reach(unpaired_variables, occurs_in, variable_of)
    regular_equations = set(range(len(incidence))) - over_equations - under_equations
    regular_variables = set(range(n_variables)) - over_variables - under_variables
    parts = (over_equations, over_variables, under_equations, under_variables, regular_equations, regular_variables)
    return CoarseDecomposition(*(tuple(sorted(part)) for part in parts))


def require_nonsingular(incidence: Sequence[Collection[int]], n_variables: int) -> list[int]:
    """The variable of each equation in a perfect matching; raises `StructurallySingular` where there is none."""
    matching = [variable for variable in maximum_matching(incidence, n_variables) if variable is not None]
    if len(matching) == len(incidence) == n_variables:
        return matching
    parts = coarse_decomposition(incidence, n_variables)
    raise StructurallySingular(parts.over_equations, parts.under_variables)


def alternating_reach(
    starts: Sequence[int], neighbours: Sequence[Collection[int]], partner: Sequence[int | None]
) -> tuple[set[int], set[int]]:
    """What alternating paths from `starts` reach: on the side of the starts, and on the other side."""
    near, far, queue = set(starts), set[int](), list(starts)
    for node in queue:
        for other in neighbours[node]:
            far.add(other)
            back = partner[other]
            if back is not None and back not in near:
                near.add(back)
                queue.append(back)
    return near, far
