"""Block triangular form: a square system split into the smallest parts that can be solved one after the other."""

from collections.abc import Collection, Sequence
from typing import NamedTuple


class Block(NamedTuple):
    """Equations that must be solved together, and the variables that they are solved for, paired in order."""

    equations: tuple[int, ...]
    variables: tuple[int, ...]


def block_triangular(incidence: Sequence[Collection[int]], matching: Sequence[int]) -> list[Block]:
    """The blocks of a square system in the order of solution: a block uses only its own variables and earlier ones.

    `incidence[i]` holds the variables of equation i, `matching[i]` the one that it is paired with. The blocks are the
    strongly connected components of the graph in which an equation points to those paired with its other variables;
    they do not depend on which perfect matching is given.

    Source: R. Tarjan, Depth-first search and linear graph algorithms, SIAM J. Comput. 1 (1972).
    """
    equation_of = {variable: equation for equation, variable in enumerate(matching)}
    successors = [[equation_of[variable] for variable in variables] for variables in incidence]
    components = _strongly_connected(successors)
    return [Block(tuple(part), tuple(matching[i] for i in part)) for part in map(sorted, components)]


def _strongly_connected(successors: Sequence[Sequence[int]]) -> list[list[int]]:
    """The strongly connected components, each after all that it points to (Tarjan's algorithm without recursion)."""
    number: dict[int, int] = {}
    lowest: dict[int, int] = {}
    stack: list[int] = []
    on_stack: set[int] = set()
    components: list[list[int]] = []
    for root in range(len(successors)):
        if root in number:
            continue
        path = [(root, iter(successors[root]))]
        number[root] = lowest[root] = len(number)
        stack.append(root)
        on_stack.add(root)
        while path:
            node, rest = path[-1]
            for other in rest:
                if other not in number:
                    number[other] = lowest[other] = len(number)
                    stack.append(other)
                    on_stack.add(other)
                    path.append((other, iter(successors[other])))
                    break
                if other in on_stack:
                    lowest[node] = min(lowest[node], number[other])
            else:
                path.pop()
                if path:
                    parent = path[-1][0]
                    lowest[parent] = min(lowest[parent], lowest[node])
                if lowest[node] == number[node]:
                    component = [stack.pop()]
                    while component[-1] != node:
                        component.append(stack.pop())
                    on_stack.difference_update(component)
                    components.append(component)
    return components
