"""Sets as nodes of a table: what is in them, against Python's own sets, and how many nodes that takes."""

import itertools

import numpy as np
import pytest

from dae_jax.structure import sets as module
from dae_jax.structure.sets import Sets


N = 12
EMPTY: frozenset[tuple[int, bool]] = frozenset()


@pytest.fixture(params=["one by one", "by numpy"])
def way(request, monkeypatch):
    """Both ways of finding unions and contents, whatever the sizes."""
    few = 10**9 if request.param == "one by one" else 0
    monkeypatch.setattr(module, "FEW", few)
    monkeypatch.setattr(module, "FEW_NODES", few)


def contents(sets, ids):
    """The elements of each set, counted from 1, and whether it is a jump."""
    on, jumps = sets.rows(np.asarray(ids))
    rows = [set() for _ in range(np.size(ids))]
    for pattern, jump in ((on, False), (jumps, True)):
        for row, column in zip(*pattern.nonzero(), strict=True):
            rows[row].add((int(column), jump))
    return [frozenset(row) for row in rows]


def by_hand(arrays, operation, rng, sets):
    """One random operation on ids and, entry by entry, on frozensets; each array is a pair of these."""
    (a, in_a), (b, in_b) = (arrays[k] for k in rng.integers(len(arrays), size=2))
    union = np.frompyfunc(frozenset.union, 2, 1)
    match operation:
        case 0:
            return sets.union(a, b), union(in_a, in_b)
        case 1:
            return sets.union(a[:, :1], b[1]), union(in_a[:, :1], in_b[1])
        case 2:
            axis = int(rng.integers(2))
            found = sets.over(a, (axis,), keepdims=True)
            return np.broadcast_to(found, a.shape), np.broadcast_to(union.reduce(in_a, axis, keepdims=True), a.shape)
        case 3:
            return sets.accumulated(a), union.accumulate(in_a, 0)
        case 4:
            places, expected = rng.integers(a.size, size=2 * a.size), in_a.reshape(-1).copy()
            new = rng.integers(b.size, size=2 * a.size)
            for place, one in zip(places, in_b.reshape(-1)[new], strict=True):
                expected[place] |= one
            return sets.at(a.reshape(-1), places, b.reshape(-1)[new]).reshape(a.shape), expected.reshape(a.shape)
        case 5:
            jumped = np.frompyfunc(lambda x: x | {(element, True) for element, _ in x}, 1, 1)
            return sets.through_jump(a), jumped(in_a)
        case _:
            mask = rng.random(a.shape) < 0.5
            return np.where(mask, 0, a), np.where(mask, EMPTY, in_a)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("seed", range(12))
def test_random_programs_are_those_of_frozensets(seed):
    rng = np.random.default_rng(seed)
    sets = Sets(N)
    single = np.arange(1, N + 1).reshape(4, 3)
    arrays = [(single, np.frompyfunc(lambda k: frozenset({(k, False)}), 1, 1)(single))]
    for _ in range(20):
        ids, expected = by_hand(arrays, rng.integers(7), rng, sets)
        arrays.append((np.broadcast_to(ids, (4, 3)), np.broadcast_to(expected, (4, 3))))
    ids, expected = (np.stack(part).reshape(-1) for part in zip(*arrays, strict=True))
    assert contents(sets, ids) == list(expected)
    for one, other in itertools.product(range(0, len(ids), 7), repeat=2):
        assert sets.equal(ids[[one]], ids[[other]]) == (expected[one] == expected[other])


@pytest.mark.usefixtures("way")
def test_sets_made_in_another_order_are_equal():
    sets = Sets(4)
    a, b, c, d = np.arange(1, 5).reshape(4, 1)
    union = sets.union
    first, second = union(union(a, b), union(c, d)), union(a, union(d, union(b, c)))
    assert (first != second).all()
    assert sets.equal(first, second)
    assert not sets.equal(first, union(a, union(b, c)))
    assert sets.equal(sets.through_jump(first), union(sets.through_jump(union(a, c)), sets.through_jump(union(b, d))))
    assert not sets.equal(first, sets.through_jump(first))


@pytest.mark.usefixtures("way")
def test_a_pair_has_one_node():
    sets = Sets(100)
    a, b = np.arange(1, 51), np.arange(51, 101)
    first = sets.union(a, b)
    before = len(sets)
    for again in (
        sets.union(a, b),
        sets.union(b, a),
        sets.union(first, a),
        sets.union(b, first),
        sets.union(first, first),
    ):
        np.testing.assert_array_equal(again, first)
    jumped = sets.through_jump(first)
    np.testing.assert_array_equal(sets.through_jump(jumped), jumped)
    np.testing.assert_array_equal(sets.union(first, jumped), jumped)
    assert len(sets) == before + 50


def test_slopes_do_not_jump():
    sets = Sets(3, slopes_only=True)
    assert not sets.through_jump(np.arange(4)).any()


def test_unions_are_as_many_as_entries():
    """Of a sum, cumulative sums and a scatter; no more, although each cumulative sum is a set of its own."""
    n = 4096
    sets = Sets(n)
    a = np.arange(1, n + 1)
    counts = [len(sets)]
    for unite in (lambda: sets.over(a, (0,)), lambda: sets.accumulated(a), lambda: sets.at(a, a % 7, a)):
        unite()
        counts.append(len(sets))
    assert (np.diff(counts) <= 2 * n).all()


def test_the_last_of_a_long_chain_is_found_alone(monkeypatch):
    """A loop's carry that grows by one element a step: what is in the carries before is not listed."""
    n = 3000
    sets = Sets(n)
    last = np.array([1])
    for k in range(2, n + 1):
        last = sets.union(last, np.array([k]))
    sorted_keys = []
    sort = np.sort
    monkeypatch.setattr(np, "sort", lambda x: sorted_keys.append(len(x)) or sort(x))
    on, _ = sets.rows(last)
    assert on.nnz == n
    assert sum(sorted_keys) <= 2 * n
