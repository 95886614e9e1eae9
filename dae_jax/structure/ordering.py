"""Orders of a symmetric sparse matrix in which its nonzeros lie in a narrow band, but for a small border."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int


@dataclasses.dataclass(frozen=True)
class BorderedOrder:
    """An order of the rows and columns of a symmetric matrix in which it reads

        [ B  E ]
        [ Eᵀ C ]      with B of half-bandwidth `bandwidth` and C as small as worthwhile.

    **Attributes**: `interior`, the rows of B in order; `border`, the rows of C; `bandwidth`, the greatest |i − j| of a
    nonzero of B.
    """

    interior: Int[np.ndarray, " interior"]
    border: Int[np.ndarray, " border"]
    bandwidth: int

    @property
    def permutation(self) -> Int[np.ndarray, " n"]:
        """All rows in order, the border last."""
        return np.concatenate([self.interior, self.border])

    @property
    def cost(self) -> int:
        """Multiplications of a factorisation, to leading order: the square of each row's length to the right."""
        n, k = len(self.interior), len(self.border)
        after = np.minimum(np.arange(n), self.bandwidth)
        return int(np.sum((1 + after + k) ** 2) + np.sum(np.arange(1, k + 1) ** 2))


def reverse_cuthill_mckee(pattern: Bool[np.ndarray, "n n"]) -> Int[np.ndarray, " n"]:
    """The rows of a symmetric pattern in the reverse Cuthill–McKee order.

    Source: A. George, J. W.-H. Liu, *Computer Solution of Large Sparse Positive Definite Systems*, section 4.3.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee as order

    if not len(pattern):
        return np.zeros(0, int)
    return np.asarray(order(csr_array(np.asarray(pattern, np.int8)), symmetric_mode=True), int)


def bandwidth(pattern: Bool[np.ndarray, "n n"], order: Int[np.ndarray, " n"] | None = None) -> int:
    """The half-bandwidth, max |i − j| over the nonzeros, of a pattern (with its rows and columns in `order`)."""
    pattern = np.asarray(pattern) if order is None else np.asarray(pattern)[np.ix_(order, order)]
    rows, columns = np.nonzero(pattern)
    return int(np.abs(rows - columns).max(initial=0))


def bordered_order(pattern: Bool[np.ndarray, "n n"], max_border: int = 8) -> BorderedOrder:
    """A narrow band with a border of at most `max_border` rows, wherever that makes a factorisation cheaper.

    Starts from the reverse Cuthill–McKee order without a border, and moves rows to the border one by one, together with
    those of the same pattern: of the rows with the most nonzeros and those at the ends of the band's widest entry, the
    one that leaves the cheapest band. The order with the lowest `cost` is kept. A chain needs no border, a closed chain
    twice its bandwidth or a border of one joint, a body that touches all others a border of its own rows.
    """
    pattern = np.asarray(pattern, bool)
    pattern = pattern | pattern.T
    best = current = _order_without(pattern, np.zeros(0, int))
    while current.bandwidth:
        borders = [np.append(current.border, rows) for rows in _candidates(pattern, current)]
        tries = [_order_without(pattern, border) for border in borders if len(border) <= max_border]
        if not tries:
            break
        current = min(tries, key=lambda order: order.cost)
        best = min(best, current, key=lambda order: order.cost)
    return best


def _order_without(pattern: np.ndarray, border: np.ndarray) -> BorderedOrder:
    """The rest in reverse Cuthill–McKee order, with `border` set apart."""
    rest = np.setdiff1d(np.arange(len(pattern)), border)
    part = pattern[np.ix_(rest, rest)]
    order = reverse_cuthill_mckee(part)
    return BorderedOrder(rest[order], border, bandwidth(part, order))


def _candidates(pattern: np.ndarray, order: BorderedOrder) -> list[np.ndarray]:
    """Rows of the interior that make its band wide, each with those of the same pattern."""
    part = pattern[np.ix_(order.interior, order.interior)]
    rows, columns = np.nonzero(part)
    widest = np.abs(rows - columns).argmax()
    chosen = dict.fromkeys([int(part.sum(1).argmax()), int(rows[widest]), int(columns[widest])])
    touching = part | np.eye(len(part), dtype=bool)
    return [order.interior[(touching == touching[row]).all(1)] for row in chosen]
