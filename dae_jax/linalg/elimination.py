"""Sparse symmetric positive definite systems in O(n): independent unknowns are eliminated together, level by level.

At each level a set of unknowns no two of which are coupled is eliminated at once, in operations on whole vectors: for a
chain every second one, which is cyclic reduction; for a tree its leaves and every second link of its branches; for a
closed chain as for an open one. That takes O(log n) levels and O(n) arithmetic where the graph of the matrix stays
sparse, and it is Gaussian elimination of a symmetrically permuted matrix, which needs no pivoting for a definite one.
The order is found once, in numpy, and none of it happens at run time.

Source: D. Heller, Some aspects of the cyclic reduction algorithm for block tridiagonal linear systems, SIAM J. Numer.
Anal. 13 (1976); M. T. Jones, P. E. Plassmann, A parallel graph coloring heuristic, SIAM J. Sci. Comput. 14 (1993).
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .definite_factors import definite_pivot
from .dense import LOOPED
from .semidefinite import semidefinite_solve


# An unknown with more couplings than this is eliminated last; what is left when all have is solved as a dense system.
MAX_DEGREE = 4
# At one level an unknown is changed by at most this many eliminations.
MAX_UPDATES = 4


@dataclasses.dataclass(frozen=True, eq=False)
class _Level:
    """One level. Indices are into the unknowns and the couplings of the level; −1 stands for nothing.

    `eliminated`, `kept`: the unknowns. `neighbour[s]`, `coupling[s]`: the s-th neighbour (a position in `kept`) of each
    eliminated unknown and the coupling to it. `from_eliminated[p]`, `from_slot[p]`: for each kept unknown the p-th
    elimination that changes it. `old`: for each new coupling the coupling that it was, and `fill[p]` the eliminations
    (position, slot, slot) that change it.
    """

    eliminated: Int[np.ndarray, " e"]
    kept: Int[np.ndarray, " k"]
    neighbour: Int[np.ndarray, "slots e"]
    coupling: Int[np.ndarray, "slots e"]
    updates: Int[np.ndarray, "p k 2"]
    old: Int[np.ndarray, " c"]
    fill: Int[np.ndarray, "q c 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Elimination:
    """The order in which a symmetric sparse matrix is eliminated.

    `rows`, `columns`: the couplings, rows < columns, whose entries `solve` wants; `levels`; `rest`: the couplings of
    the dense system that is left. Compared by identity: keep one for each pattern.
    """

    size: int
    rows: Int[np.ndarray, " c"]
    columns: Int[np.ndarray, " c"]
    levels: tuple[_Level, ...]
    rest: tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]
    rest_size: int

    @property
    def cost(self) -> int:
        """Multiplications of a solve, to leading order."""
        levels = sum(int((level.neighbour >= 0).sum() * (1 + len(level.neighbour))) for level in self.levels)
        return self.size + 3 * levels + self.rest_size**3 // 6

    def solve(
        self, diagonal: Float[Array, " n"], couplings: Float[Array, " c"], b: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """x with S x = b for positive definite S, given by its diagonal and its entries at (`rows`, `columns`).

        A pivot that is not positive beyond round-off gives NaN.
        """
        scale = diagonal
        history = []
        for level in self.levels:
            pivot = definite_pivot(take(diagonal, level.eliminated), take(scale, level.eliminated), self.size)
            below = [take(couplings, c) for c in level.coupling]
            factors = [w / pivot for w in below]
            x = take(b, level.eliminated)
            history.append((level, pivot, factors, x))
            diagonal = _updated(diagonal, level, [f * w for f, w in zip(factors, below, strict=True)])
            b = _updated(b, level, [f * x for f in factors])
            scale = take(scale, level.kept)
            couplings = _filled(couplings, level, factors, below)
        x = self._solve_rest(diagonal, couplings, b)
        for level, pivot, factors, right in reversed(history):
            eliminated = right / pivot
            for f, neighbour in zip(factors, level.neighbour, strict=True):
                eliminated = eliminated - f * take(x, neighbour)
            x = _merged(eliminated, x, level)
        return x

    def _solve_rest(self, diagonal: Float[Array, " r"], couplings: Float[Array, " c"], b: Float[Array, " r"]) -> Array:
        n = self.rest_size
        if n == 1:
            return b / definite_pivot(diagonal, diagonal, self.size)
        rows, columns = self.rest
        position = np.full((n, n), -1)
        position[np.arange(n), np.arange(n)] = np.arange(n)
        position[rows, columns] = position[columns, rows] = n + np.arange(len(rows))
        dense = take(jnp.concatenate([diagonal, couplings]), position.reshape(-1)).reshape(n, n)
        return semidefinite_solve(dense, b)


def elimination(pattern: Bool[np.ndarray, "n n"]) -> Elimination:
    """The order for matrices with the given symmetric pattern."""
    pattern = np.asarray(pattern, bool)
    n = len(pattern)
    rows, columns = np.nonzero(np.triu(pattern | pattern.T, 1))
    edges = {(int(i), int(j)): k for k, (i, j) in enumerate(zip(rows, columns, strict=True))}
    levels = []
    size = n
    while size > 1:
        chosen = _independent(size, edges)
        if not chosen:
            break
        level, edges = _level(size, edges, chosen)
        levels.append(level)
        size = len(level.kept)
    rest = np.array(list(edges), int).reshape(-1, 2).T
    return Elimination(n, rows, columns, tuple(levels), (rest[0], rest[1]), size)


def _neighbours(size: int, edges: dict[tuple[int, int], int]) -> list[list[int]]:
    found: list[list[int]] = [[] for _ in range(size)]
    for i, j in edges:
        found[i].append(j)
        found[j].append(i)
    return found


def _independent(size: int, edges: dict[tuple[int, int], int]) -> list[int]:
    """Unknowns of low degree, no two of them coupled, in their order."""
    neighbours = _neighbours(size, edges)
    limit = max(2, min(map(len, neighbours)))
    if limit > MAX_DEGREE:
        return []
    updates = [0] * size
    blocked = [False] * size
    chosen = []
    for node, around in enumerate(neighbours):
        if blocked[node] or len(around) > limit or any(updates[other] == MAX_UPDATES for other in around):
            continue
        if len(chosen) == size - 1:
            break
        chosen.append(node)
        blocked[node] = True
        for other in around:
            blocked[other] = True
            updates[other] += 1
    return chosen


def _level(
    size: int, edges: dict[tuple[int, int], int], chosen: list[int]
) -> tuple[_Level, dict[tuple[int, int], int]]:
    neighbours = _neighbours(size, edges)
    out = set(chosen)
    kept = [node for node in range(size) if node not in out]
    position = {node: k for k, node in enumerate(kept)}
    slots = max(len(neighbours[node]) for node in chosen)
    neighbour = np.full((slots, len(chosen)), -1)
    coupling = np.full((slots, len(chosen)), -1)
    updates: list[list[tuple[int, int]]] = [[] for _ in kept]
    old: dict[tuple[int, int], int] = {
        (position[i], position[j]): k for (i, j), k in edges.items() if i not in out and j not in out
    }
    fill: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    for e, node in enumerate(chosen):
        around = sorted(neighbours[node])
        for s, other in enumerate(around):
            neighbour[s, e] = position[other]
            coupling[s, e] = edges[min(node, other), max(node, other)]
            updates[position[other]].append((e, s))
            for r in range(s):
                fill.setdefault((position[around[r]], position[other]), []).append((e, r, s))
    new = {edge: k for k, edge in enumerate(sorted({*old, *fill}))}
    level = _Level(
        np.array(chosen), np.array(kept), neighbour, coupling, _padded(updates, 2),
        np.array([old.get(edge, -1) for edge in new], int), _padded([fill.get(edge, []) for edge in new], 3),
    )  # fmt: skip
    return level, new


def _padded(lists: Sequence[Sequence[tuple[int, ...]]], width: int) -> np.ndarray:
    """(longest, len(lists), width), with −1 where a list has ended."""
    table = np.full((max(map(len, lists), default=0), len(lists), width), -1)
    for k, entries in enumerate(lists):
        for p, entry in enumerate(entries):
            table[p, k] = entry
    return table


# The numerical side: data movement with fixed indices


def _updated(x: Array, level: _Level, contributions: list[Array]) -> Array:
    """The kept entries of x, less what the eliminations take from them."""
    new = take(x, level.kept)
    for entry in level.updates:
        for s, contribution in enumerate(contributions):
            at = np.where(entry[:, 1] == s, entry[:, 0], -1)
            if (at >= 0).any():
                new = new - take(contribution, at)
    return new


def _filled(couplings: Array, level: _Level, factors: list[Array], below: list[Array]) -> Array:
    new = take(couplings, level.old)
    for entry in level.fill:
        for r, s in sorted({(int(r), int(s)) for _, r, s in entry if r >= 0}):
            at = np.where((entry[:, 1] == r) & (entry[:, 2] == s), entry[:, 0], -1)
            new = new - take(factors[r] * below[s], at)
    return new


def _merged(eliminated: Array, kept: Array, level: _Level) -> Array:
    size = len(level.eliminated) + len(level.kept)
    at = np.empty(size, int)
    at[level.eliminated] = np.arange(len(level.eliminated))
    at[level.kept] = len(level.eliminated) + np.arange(len(level.kept))
    alternate = np.arange(size)
    if np.array_equal(level.eliminated, alternate[::2]) and np.array_equal(level.kept, alternate[1::2]):
        # Two halves like the teeth of two combs: no gather.
        pairs = jnp.stack([eliminated[: len(kept)], kept], 1).reshape(-1)
        return jnp.concatenate([pairs, eliminated[len(kept) :]])
    return take(jnp.concatenate([eliminated, kept]), at)


def take(x: Array, index: Int[np.ndarray, " k"]) -> Array:
    """x[index], 0 where the index is −1; a slice where the indices are evenly spaced."""
    k = len(index)
    used = np.flatnonzero(index >= 0)
    if not len(used):
        return jnp.zeros(k, x.dtype)
    first, last = int(used[0]), int(used[-1])
    inner = index[first : last + 1]
    step = int(inner[1] - inner[0]) if len(inner) > 1 else 1
    if step > 0 and np.array_equal(inner, inner[0] + step * np.arange(len(inner))):
        piece = lax.slice(x, (int(inner[0]),), (int(inner[-1]) + 1,), (step,))
        return lax.pad(piece, jnp.zeros((), x.dtype), [(first, k - 1 - last, 0)]) if len(inner) < k else piece
    taken = x[np.maximum(index, 0)]
    return taken if len(used) == k else jnp.where(index >= 0, taken, 0)


def powers(x: Float[Array, "*#n"], exponents: tuple[int, ...]) -> Float[Array, " n"]:
    """x, a number or one for each, to each of the exponents."""
    values = [jnp.ones_like(x)]
    for _ in range(max(exponents, default=0)):
        values.append(values[-1] * x)
    if len(exponents) > LOOPED:
        return jnp.stack(values)[(np.array(exponents), np.arange(len(exponents)))[: 1 + x.ndim]]
    return jnp.stack([values[k][i] if x.ndim else values[k] for i, k in enumerate(exponents)])
