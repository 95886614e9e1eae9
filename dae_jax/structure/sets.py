"""Sets of inputs as numbers: a union is made once and looked up after that; what is in the sets is found at the end.

The table is a binary decision diagram's unique table in its simplest form: equal pairs have equal ids. Equal ids are equal
sets; the converse does not hold, for which there is `Sets.equal`.

Source: J.-C. Filliâtre, S. Conchon, Type-safe modular hash-consing, Workshop on ML (2006).
"""

import contextlib
from array import array
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_array

from .set_elements import elements, listed_elements


# An array of ids; an entry is the set that an entry of another array depends on.
Ids = Int[np.ndarray, "..."]

# Unions of fewer entries, and the contents of fewer sets, are found one by one: numpy takes longer to begin.
FEW, FEW_NODES = 64, 512


class Sets:
    """Unions of single elements, by their ids: 0 is the empty set, 1 to `n` hold one input each.

    Of what is reached through a *jump* (a comparison, rounding, a truth value) this is remembered beside: `through_jump`. With
    `slopes_only` such sets are empty.

    Node k stands for `left[k]` ∪ `right[k]`, both smaller ids; where `left[k]` is 0, for `right[k]` reached through a jump.
    `level` is the length of the longest way from a node to single elements, whose level is 0.
    """

    def __init__(self, n: int, slopes_only: bool = False) -> None:
        self.slopes_only, self._smooth = slopes_only, False
        self.left, self.right, self.level = array("q"), array("q"), array("q")
        self._known: dict[int, int] = {}
        self._runs: list[tuple[np.ndarray, np.ndarray]] = []
        self._append(np.zeros(1 + n, np.int64), np.zeros(1 + n, np.int64), np.zeros(1 + n, np.int64))

    def __len__(self) -> int:
        """How many sets there are, also those that nothing refers to any more."""
        return len(self.left)

    def new_elements(self, count: int) -> Ids:
        """The ids of sets of a new element each."""
        first, zeros = len(self), np.zeros(count, np.int64)
        self._append(zeros, zeros, zeros)
        return np.arange(first, first + count)

    # Unions

    def union(self, a: Ids, b: Ids) -> Ids:
        """Entry by entry; the shapes broadcast."""
        if a.size < FEW and b.size < FEW:
            if a.shape != b.shape:
                a, b = np.broadcast_arrays(a, b)
            return np.array(list(map(self._pair, a.ravel().tolist(), b.ravel().tolist())), np.int64).reshape(a.shape)
        low, high = np.minimum(a, b), np.asarray(np.maximum(a, b))
        both = (low > 0) & (low < high)
        if both.any():
            high[both] = self._looked_up(low[both] << 32 | high[both])
        return high

    @contextlib.contextmanager
    def smooth_through_jumps(self) -> Iterator[None]:
        """Jumps are none meanwhile."""
        before, self._smooth = self._smooth, True
        try:
            yield
        finally:
            self._smooth = before

    def through_jump(self, a: Ids) -> Ids:
        """The same elements, all of them reached through a jump."""
        if self._smooth:
            return a
        if self.slopes_only or not a.any():
            return np.zeros_like(a)
        if a.size < FEW:
            return np.array(list(map(self._jumped, a.ravel().tolist())), np.int64).reshape(a.shape)
        left, level = np.frombuffer(self.left, np.int64), np.frombuffer(self.level, np.int64)
        new = (a > 0) & ((left[a] > 0) | (level[a] == 0))
        del left, level
        found = a.copy()
        found[new] = self._looked_up(a[new])
        return found

    def over(self, a: Ids, axes: tuple[int, ...], keepdims: bool = False) -> Ids:
        """The union along `axes`, in halves: log n unions, one in the other."""
        shape = [1 if axis in axes else size for axis, size in enumerate(a.shape)]
        rest = [size for axis, size in enumerate(a.shape) if axis not in axes]
        a = np.moveaxis(a, axes, range(len(axes))).reshape(int(np.prod([a.shape[axis] for axis in axes])), *rest)
        while len(a) > 1:
            half = len(a) // 2
            joined = self.union(a[:half], a[half : 2 * half])
            a = np.concatenate([joined, a[2 * half :]]) if len(a) % 2 else joined
        found = a[0] if len(a) else np.zeros(rest, np.int64)
        return found.reshape(shape) if keepdims else found

    def accumulated(self, a: Ids) -> Ids:
        """The unions a₀, a₀ ∪ a₁, … along the first axis, of fewer than twice as many pairs.

        Source: R. P. Brent, H. T. Kung, A regular layout for parallel adders, IEEE Trans. Comput. C-31 (1982).
        """
        if len(a) < 2:
            return a
        found = a.copy()
        found[1::2] = self.accumulated(self.union(a[:-1:2], a[1::2]))
        found[2::2] = self.union(found[1:-1:2], a[2::2])
        return found

    def at(self, a: Int[np.ndarray, " n"], places: Int[np.ndarray, " k"], new: Int[np.ndarray, " k"]) -> Ids:
        """`a` with each of the `new` sets joined at its place, of which there may be several at one."""
        found = a.copy()
        if len(places) < FEW:
            for place, one in zip(places.tolist(), new.tolist(), strict=True):
                found[place] = self._pair(int(found[place]), one)
            return found
        order = np.argsort(places, kind="stable")
        places, new = places[order], new[order]
        while True:
            first = np.flatnonzero(np.diff(places, prepend=-1))
            if len(first) == len(places):
                break
            rank = np.arange(len(places)) - np.repeat(first, np.diff(first, append=len(places)))
            even = np.flatnonzero(rank % 2 == 0)
            partner = np.minimum(even + 1, len(places) - 1)
            places, new = places[even], self.union(new[even], np.where(rank[partner] % 2, new[partner], 0))
        found[places] = self.union(a[places], new)
        return found

    # What is in them

    def equal(self, a: Ids, b: Ids) -> bool:
        """Whether all entries are the same sets, however they were made."""
        unlike = a != b
        if not unlike.any():
            return True
        return all(
            np.array_equal(x.indptr, y.indptr) and np.array_equal(x.indices, y.indices)
            for x, y in zip(self.rows(a[unlike]), self.rows(b[unlike]), strict=True)
        )

    def rows(self, a: Ids) -> tuple[csr_array, csr_array]:
        """The sets as rows of truth values, a column for each id of a single element, and those of what is reached through
        jumps.
        """
        if len(self) < FEW_NODES:
            length, columns = listed_elements(self.left, self.right, a.reshape(-1).tolist())
        else:
            left, right, level = (np.array(x) for x in (self.left, self.right, self.level))
            length, columns = elements(left, right, level, a.reshape(-1))
        rows, jumps = np.repeat(np.arange(a.size), length), columns % 2 == 1
        shape = (a.size, len(self))
        if not jumps.any():
            return _matrix(rows, columns // 2, shape), csr_array(shape, dtype=bool)
        return _matrix(rows[~jumps], columns[~jumps] // 2, shape), _matrix(rows[jumps], columns[jumps] // 2, shape)

    # The table

    def _pair(self, a: int, b: int) -> int:
        """The union of two."""
        if a == b or not b:
            return a
        if not a:
            return b
        if a > b:
            a, b = b, a
        return b if a in (self.left[b], self.right[b]) else self._node(a, b)

    def _jumped(self, a: int) -> int:
        """A set reached through a jump."""
        return a if not a or (self.level[a] and not self.left[a]) else self._node(0, a)

    def _node(self, a: int, b: int) -> int:
        """The id of a pair."""
        found = self._known.setdefault(a << 32 | b, len(self.left))
        if found == len(self.left):
            self.left.append(a)
            self.right.append(b)
            self.level.append(1 + max(self.level[a], self.level[b]))
        return found

    def _looked_up(self, keys: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """The ids of pairs (a, b), given as 2³² a + b: known ones, or new ones."""
        keys, which = np.unique(keys, return_inverse=True)
        found = np.zeros_like(keys)
        for known, ids in self._runs:
            at = np.minimum(np.searchsorted(known, keys), len(known) - 1)
            found = np.where(known[at] == keys, ids[at], found)
        new = np.flatnonzero(found == 0)
        a, b = keys[new] >> 32, keys[new] & 0xFFFFFFFF
        left, right, level = (np.frombuffer(x, np.int64) for x in (self.left, self.right, self.level))
        within = (a > 0) & ((left[b] == a) | (right[b] == a))
        levels = 1 + np.maximum(level[a], level[b])
        del left, right, level  # which would keep the table from growing
        found[new] = np.where(within, b, len(self) + np.cumsum(~within) - 1)
        self._append(a[~within], b[~within], levels[~within])
        self._remember(keys[new], found[new])
        return found[which]

    def _remember(self, keys: np.ndarray, ids: np.ndarray) -> None:
        """Sorted runs, each more than the one after it: as many as the logarithm of their length."""
        while self._runs and len(self._runs[-1][0]) <= len(keys):
            known, of_known = self._runs.pop()
            keys, ids = np.append(known, keys), np.append(of_known, ids)
            order = np.argsort(keys, kind="stable")
            keys, ids = keys[order], ids[order]
        if len(keys):
            self._runs.append((keys, ids))

    def _append(self, *columns: np.ndarray) -> None:
        for stored, column in zip((self.left, self.right, self.level), columns, strict=True):
            stored.frombytes(column.astype(np.int64).tobytes())


def _matrix(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csr_array:
    """With `True` at these places, which are in order."""
    indptr = np.append(0, np.cumsum(np.bincount(rows, minlength=shape[0])))
    return csr_array((np.ones(len(rows), bool), columns, indptr), shape)
