"""What is in the sets of a table of unions, see `Sets`.

An element is given as 2 k for that of id k, 2 k + 1 where it is reached through a jump.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int


# How many elements each of some sets has, and all of them, ascending for each set.
Elements = tuple[Int[np.ndarray, " sets"], Int[np.ndarray, " elements"]]


def listed_elements(left: Sequence[int], right: Sequence[int], roots: Sequence[int]) -> Elements:
    """The elements of the `roots`, in plain Python, for a table of few nodes."""
    found: list[set[int]] = []
    for node, (a, b) in enumerate(zip(left, right, strict=True)):
        if a:
            found.append(found[a] | found[b])
        elif b:
            found.append(found[b] | {element | 1 for element in found[b]})
        else:
            found.append({2 * node} if node else set())
    of_roots = [sorted(found[root]) for root in roots]
    return np.array(list(map(len, of_roots)), int), np.array([element for part in of_roots for element in part], int)


def elements(left: np.ndarray, right: np.ndarray, level: np.ndarray, roots: np.ndarray) -> Elements:
    """The elements of the `roots`, from the single elements upward, level by level, of those nodes alone that are roots or that
    several others refer to: a long chain of unions in a loop, of which the last counts, is gone through once.
    """
    inner, single = _needed(left, right, level, roots)
    jumped = np.zeros(len(left), bool)
    jumped[inner] = left[inner] == 0
    of, child = _edges(left, right, inner, roots, jumped)
    order = np.argsort(level[of], kind="stable")
    of, child = of[order], child[order]

    first, length = np.zeros(len(left), np.int64), np.zeros(len(left), np.int64)
    first[single], length[single] = np.arange(len(single)), 1
    stored, used = 2 * single, len(single)
    for edges in np.split(np.arange(len(of)), np.flatnonzero(np.diff(level[of])) + 1):
        which, places = ragged(first[child[edges]], length[child[edges]])
        nodes, found = of[edges][which], stored[places]
        through = jumped[nodes]
        nodes, found = np.append(nodes, nodes[through]), np.append(found, found[through] | 1)
        # `np.unique` would hash them first, which takes ten times as long.
        keys = np.sort(nodes * (2 * len(left)) + found)
        nodes, found = np.divmod(keys[np.diff(keys, prepend=-1) > 0], 2 * len(left))
        if used + len(found) > len(stored):
            stored = np.append(stored, np.zeros(used + len(found), np.int64))
        stored[used : used + len(found)] = found
        begins = np.flatnonzero(np.diff(nodes, prepend=-1))
        first[nodes[begins]], length[nodes[begins]] = used + begins, np.diff(begins, append=len(nodes))
        used += len(found)
    return length[roots], stored[ragged(first[roots], length[roots])[1]]


def ragged(first: Int[np.ndarray, " k"], length: Int[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """The places first, first + 1, …, as many as `length`, of one entry after the other: which entry each belongs to, and they."""
    which = np.repeat(np.arange(len(length)), length)
    return which, np.arange(len(which)) + np.repeat(first - np.cumsum(length) + length, length)


def _needed(left: np.ndarray, right: np.ndarray, level: np.ndarray, roots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unions and the single elements that the roots are made of."""
    needed: Bool[np.ndarray, " nodes"] = np.zeros(len(left), bool)
    needed[roots] = True
    by_level = np.argsort(level, kind="stable")
    ends = np.searchsorted(level[by_level], np.arange(level[roots].max(initial=0) + 2))
    for low, high in zip(ends[-2:0:-1], ends[:1:-1], strict=True):
        nodes = by_level[low:high]
        nodes = nodes[needed[nodes]]
        needed[left[nodes]] = needed[right[nodes]] = True
    needed[0] = False
    return np.flatnonzero(needed & (level > 0)), np.flatnonzero(needed & (level == 0))


def _edges(
    left: np.ndarray, right: np.ndarray, inner: np.ndarray, roots: np.ndarray, jumped: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """From nodes to what they are made of, when nodes that one other alone refers to are made part of it; not across a jump."""
    of, child = np.tile(inner, 2), np.concatenate([left[inner], right[inner]])
    kept = np.bincount(child, minlength=len(left)) != 1
    kept[left == 0] = kept[roots] = kept[right[jumped]] = True
    owner = np.arange(len(left))
    owner[child[~kept[child]]] = of[~kept[child]]
    while (owner[owner] != owner).any():
        owner = owner[owner]
    edge = kept[child] & (child > 0)
    return owner[of[edge]], child[edge]
