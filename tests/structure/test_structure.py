"""Structural analysis on plain integers: published examples, and agreement with brute force and with scipy."""

import itertools
import random

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

from dae_jax.structure import (
    StructurallySingular,
    bandwidth,
    block_triangular,
    bordered_order,
    coarse_decomposition,
    column_colouring,
    jacobian_pattern,
    maximum_matching,
    pantelides,
    reverse_cuthill_mckee,
    seed_matrix,
    sigma_method,
)
from dae_jax.structure.sigma import highest_value_transversal


# x, y, u, v, λ: ẋ = u, ẏ = v, u̇ = −λx, v̇ = −λy − g, x² + y² = L².
PENDULUM_FIRST_ORDER = [{0: 1, 2: 0}, {1: 1, 3: 0}, {2: 1, 4: 0, 0: 0}, {3: 1, 4: 0, 1: 0}, {0: 0, 1: 0}]
# x, y, λ (Pryce 2001, section 1).
PENDULUM = [{0: 2, 2: 0}, {1: 2, 2: 0}, {0: 0, 1: 0}]
# x1, y1, x2, y2, λ1, λ2: two masses on rods, the second hanging from the first.
DOUBLE_PENDULUM = [
    {0: 2, 2: 0, 4: 0, 5: 0},
    {1: 2, 3: 0, 4: 0, 5: 0},
    {0: 0, 2: 2, 5: 0},
    {1: 0, 3: 2, 5: 0},
    {0: 0, 1: 0},
    {0: 0, 1: 0, 2: 0, 3: 0},
]
# Two pendula, x, y, λ, u, v, μ: the second has the length L + cλ (Pryce 2001). In the modified form (N. S. Nedialkov,
# J. D. Pryce, Solving DAEs by Taylor series II, BIT 47, 2007), d³v/dt³ enters the fifth equation and d²λ/dt² the last.
TWO_PENDULA = [*PENDULUM, {3: 2, 5: 0}, {4: 2, 5: 0}, {3: 0, 4: 0, 2: 0}]
MODIFIED_PENDULA = [*PENDULUM, {3: 2, 5: 0}, {4: 3, 5: 0}, {3: 0, 4: 0, 2: 2}]
# Campbell and Griepentrog's robot arm with prescribed end point, x1, x2, x3, u1, u2 (Pryce 2001).
ROBOT_ARM = [
    {0: 2, 1: 0, 2: 1, 3: 0, 4: 0},
    {0: 1, 1: 2, 2: 1, 3: 0, 4: 0},
    {0: 1, 1: 0, 2: 2, 3: 0, 4: 0},
    {0: 0, 2: 0},
    {0: 0, 2: 0},
]


def hessenberg(n):
    """x1 = a(t), ẋ1 = x2, ..., ẋ(n−1) = xn: of index n."""
    return [{i: 1, i + 1: 0} for i in range(n - 1)] + [{0: 0}]


def reissig(k):
    """A of the system A ẋ + x = q(t) of Reißig, Martinson and Barton (2000): of index 1, whatever k."""
    A = np.zeros((2 * k + 1, 2 * k + 1))
    for block in range(k):
        A[2 * block : 2 * block + 2, 2 * block + 1 : 2 * block + 3] = 1
    return A


def random_signature(rng, n, extra, orders=2):
    """A structurally nonsingular signature: a hidden transversal and some more entries."""
    hidden = list(range(n))
    rng.shuffle(hidden)
    rows = [{hidden[i]: rng.randint(0, orders)} for i in range(n)]
    for row in rows:
        row.update({rng.randrange(n): rng.randint(0, orders) for _ in range(rng.randint(0, extra))})
    return rows


RANDOM = [random_signature(random.Random(seed), 1 + seed % 12, 1 + seed % 4) for seed in range(120)]


@pytest.mark.parametrize(
    ("rows", "c", "d", "dof", "index"),
    [
        (PENDULUM_FIRST_ORDER, (1, 1, 0, 0, 2), (2, 2, 1, 1, 0), 2, 3),
        (PENDULUM, (0, 0, 2), (2, 2, 0), 2, 3),
        (DOUBLE_PENDULUM, (0, 0, 0, 0, 2, 2), (2, 2, 2, 2, 0, 0), 4, 3),
        (TWO_PENDULA, (2, 2, 4, 0, 0, 2), (4, 4, 2, 2, 2, 0), 4, 5),
        (MODIFIED_PENDULA, (4, 4, 6, 0, 0, 2), (6, 6, 4, 2, 3, 0), 5, 7),
        (ROBOT_ARM, (0, 0, 0, 2, 2), (2, 2, 2, 0, 0), 2, 3),
        (hessenberg(4), (2, 1, 0, 3), (3, 2, 1, 0), 0, 4),
        ([{0: 1}], (0,), (1,), 1, 0),  # an ODE
        ([{0: 1, 1: 0}, {0: 0, 1: 0}], (0, 0), (1, 0), 1, 1),  # semi-explicit, index 1
        ([{0: 1, 1: 0}, {0: 0}], (0, 1), (1, 0), 0, 2),  # semi-explicit, index 2
    ],
    ids=["pendulum1", "pendulum2", "double", "two", "modified", "robot", "hessenberg", "ode", "index1", "index2"],
)
def test_published_offsets(rows, c, d, dof, index):
    analysis = sigma_method(rows)
    assert analysis.equation_offsets == c
    assert analysis.variable_offsets == d
    assert analysis.degrees_of_freedom == dof
    assert analysis.index == index
    found = pantelides(rows)
    assert (found.equation_offsets, found.variable_orders) == (c, d)


@pytest.mark.parametrize("k", range(1, 7))
def test_index_1_system_of_high_structural_index(k):
    A = reissig(k)
    assert np.linalg.matrix_rank(A) == np.linalg.matrix_rank(A @ A)  # A ẋ + x = q has index 1
    rows = [{int(j): 1 if A[i, j] else 0 for j in {*np.flatnonzero(A[i]), i}} for i in range(len(A))]
    analysis = sigma_method(rows)
    assert analysis.index == k + 1
    assert max(pantelides(rows).equation_offsets) == k
    assert analysis.degrees_of_freedom == np.linalg.matrix_rank(A)


def test_robot_arm_has_a_singular_jacobian_that_its_structure_hides():
    """The controls enter as in Pryce (2001): u1 − u2 in two equations. The true index is 5."""
    analysis = sigma_method(ROBOT_ARM)
    pattern = jacobian_pattern(ROBOT_ARM, analysis.equation_offsets, analysis.variable_offsets)
    assert [sorted(row) for row in pattern] == [[0, 3, 4], [1, 3, 4], [2, 3, 4], [0, 2], [0, 2]]
    J = np.zeros((5, 5))
    J[0, [0, 3, 4]] = 1, -2, 2
    J[1, [1, 3, 4]] = 1, 2, -5
    J[2, [2, 3, 4]] = 1, 3, -3
    J[3, [0, 2]], J[4, [0, 2]] = (0.3, 0.7), (0.2, -0.4)
    assert np.linalg.matrix_rank(J) == 4
    assert {(i, j) for i, j in np.argwhere(J)} == {(i, j) for i, row in enumerate(pattern) for j in row}


@pytest.mark.parametrize("rows", RANDOM, ids=str)
def test_sigma_method_and_pantelides_agree(rows):
    analysis, found = sigma_method(rows), pantelides(rows)
    assert found.equation_offsets == analysis.equation_offsets
    assert found.variable_orders == analysis.variable_offsets
    for equation, variable in enumerate(found.matching):
        order = rows[equation][variable]
        assert found.variable_orders[variable] - found.equation_offsets[equation] == order
    assert sorted(found.matching) == sorted(analysis.transversal) == list(range(len(rows)))


@pytest.mark.parametrize("rows", [rows for rows in RANDOM if len(rows) <= 6], ids=str)
def test_transversal_has_the_highest_value(rows):
    n = len(rows)
    values = [
        sum(rows[i][j] for i, j in enumerate(choice))
        for choice in itertools.permutations(range(n))
        if all(j in rows[i] for i, j in enumerate(choice))
    ]
    assert sigma_method(rows).degrees_of_freedom == max(values)


@pytest.mark.parametrize("n", [10, 40, 80])
def test_transversal_as_valuable_as_that_of_scipy(n):
    rows = random_signature(random.Random(n), n, 6, orders=5)
    value = np.full((n, n), -1e6)
    for i, row in enumerate(rows):
        for j, order in row.items():
            value[i, j] = order
    i, j = scipy.optimize.linear_sum_assignment(value, maximize=True)
    ours = highest_value_transversal(rows)
    assert sum(rows[i][j] for i, j in enumerate(ours)) == value[i, j].sum()


@pytest.mark.parametrize("rows", [rows for rows in RANDOM if len(rows) > 6][:20], ids=str)
def test_offsets_are_the_smallest(rows):
    """They minimise Σ c + Σ d subject to d_j − c_i ≥ σ_ij with equality on the transversal."""
    n, analysis = len(rows), sigma_method(rows)
    entries = [(i, j, order) for i, row in enumerate(rows) for j, order in row.items()]
    A, b = np.zeros((len(entries) + n, 2 * n)), np.zeros(len(entries) + n)
    for k, (i, j, order) in enumerate(entries):
        A[k, [i, n + j]], b[k] = (1, -1), -order
    for i, j in enumerate(analysis.transversal):
        A[len(entries) + i, [i, n + j]], b[len(entries) + i] = (-1, 1), rows[i][j]
    best = scipy.optimize.linprog(np.ones(2 * n), A_ub=A, b_ub=b)
    np.testing.assert_allclose(best.x, [*analysis.equation_offsets, *analysis.variable_offsets], atol=1e-9)


def test_structurally_singular_system_names_its_parts():
    """Equations 0, 1, 2 share the variables 0, 1; the variables 3, 4 have the equation 4 alone."""
    rows = [{0: 0, 1: 1}, {0: 1}, {1: 0}, {0: 0, 2: 1}, {2: 0, 3: 0, 4: 2}]
    for analyse in (sigma_method, pantelides):
        with pytest.raises(StructurallySingular) as raised:
            analyse(rows)
        assert raised.value.equations == (0, 1, 2)
        assert raised.value.variables == (3, 4)
        assert "[0, 1, 2]" in str(raised.value)
    parts = coarse_decomposition(rows, 5)
    assert parts.over_variables == (0, 1)
    assert parts.under_equations == (4,)
    assert parts.regular_equations == (3,)
    assert parts.regular_variables == (2,)


@pytest.mark.parametrize(
    ("rows", "n", "equations", "variables"),
    [([{0: 0}, {0: 1}], 1, (0, 1), ()), ([{0: 0, 1: 0}], 2, (), (0, 1)), ([{}, {0: 0, 1: 0}], 2, (0,), (0, 1))],
)
def test_systems_that_are_not_square_or_have_an_empty_equation(rows, n, equations, variables):
    for analyse in (sigma_method, pantelides):
        with pytest.raises(StructurallySingular) as raised:
            analyse(rows, n)
        assert (raised.value.equations, raised.value.variables) == (equations, variables)


@pytest.mark.parametrize("seed", range(40))
def test_matching_and_coarse_decomposition(seed):
    rng = random.Random(seed)
    m, n = rng.randint(1, 12), rng.randint(1, 12)
    rows = [{rng.randrange(n) for _ in range(rng.randint(0, 3))} for _ in range(m)]
    matrix = np.array([[j in row for j in range(n)] for row in rows], int)

    def size(incidence):
        if not incidence:
            return 0
        matrix = scipy.sparse.csr_array(np.array([[j in row for j in range(n)] for row in incidence], int))
        return int((scipy.sparse.csgraph.maximum_bipartite_matching(matrix, "column") >= 0).sum())

    matching = maximum_matching(rows, n)
    paired = [(i, j) for i, j in enumerate(matching) if j is not None]
    assert all(j in rows[i] for i, j in paired)
    assert len({j for _, j in paired}) == len(paired) == size(rows)

    parts = coarse_decomposition(rows, n)
    redundant = tuple(i for i in range(m) if size(rows[:i] + rows[i + 1 :]) == len(paired))
    assert parts.over_equations == redundant  # each could be left out of a greatest matching
    assert parts.over_variables == tuple(np.flatnonzero(matrix[list(redundant)].any(0)))
    free = tuple(j for j in range(n) if size([row - {j} for row in rows]) == len(paired))
    assert parts.under_variables == free
    assert parts.under_equations == tuple(np.flatnonzero(matrix[:, list(free)].any(1)))
    assert len(parts.regular_equations) == len(parts.regular_variables)


def test_blocks_of_a_small_system():
    rows = [{0, 1}, {0, 1}, {2}, {2, 3, 1}]
    blocks = block_triangular(rows, [0, 1, 2, 3])
    assert [set(block.equations) for block in blocks] == [{0, 1}, {2}, {3}]


@pytest.mark.parametrize("rows", RANDOM[::4], ids=str)
def test_block_triangular_form(rows):
    n = len(rows)
    matching = pantelides(rows).matching
    blocks = block_triangular(rows, matching)
    assert sorted(i for block in blocks for i in block.equations) == list(range(n))
    solved = set()
    for block in blocks:
        assert [matching[i] for i in block.equations] == list(block.variables)
        solved |= set(block.variables)
        assert all(set(rows[i]) <= solved for i in block.equations)
    graph = np.zeros((n, n), int)
    for i, row in enumerate(rows):
        graph[i, [matching.index(j) for j in row]] = 1
    count, _ = scipy.sparse.csgraph.connected_components(scipy.sparse.csr_array(graph), connection="strong")
    assert len(blocks) == count
    other = block_triangular(rows, [j for j in maximum_matching(rows, n) if j is not None])
    assert {frozenset(block.equations) for block in blocks} == {frozenset(block.equations) for block in other}


class CountedRow(dict):
    """A row of a signature that counts how often it is looked through."""

    looks = 0

    def items(self):
        CountedRow.looks += 1
        return super().items()

    def __iter__(self):
        CountedRow.looks += 1
        return super().__iter__()


@pytest.mark.parametrize("make", [lambda: random_signature(random.Random(0), 200, 4), lambda: hessenberg(200)])
def test_200_equations_take_few_looks(make):
    """The quick sparse path is taken: far fewer looks at rows than the n³ of a dense assignment."""
    rows = [CountedRow(row) for row in make()]
    for analyse in (sigma_method, pantelides):
        CountedRow.looks = 0
        analyse(rows)
        assert CountedRow.looks <= 4 * len(rows) ** 2


def chain(n, width=1):
    i = np.arange(n)
    return np.abs(i[:, None] - i) <= width


def closed_chain(n):
    pattern = chain(n)
    pattern[0, -1] = pattern[-1, 0] = True
    return pattern


def shuffled(pattern, seed=0):
    order = np.random.default_rng(seed).permutation(len(pattern))
    return pattern[np.ix_(order, order)]


@pytest.mark.parametrize(
    ("pattern", "most"),
    [(shuffled(chain(40)), 3), (shuffled(closed_chain(40)), 4), (chain(30, 2), 5), (np.ones((4, 6), bool), 6)],
)
def test_colouring_recovers_the_jacobian(pattern, most):
    colours = column_colouring(pattern)
    assert colours.max() + 1 <= most
    J = pattern * np.random.default_rng(1).normal(size=pattern.shape)
    compressed = J @ seed_matrix(colours)
    rows, columns = np.nonzero(pattern)
    np.testing.assert_array_equal(compressed[rows, colours[columns]], J[rows, columns])


def test_colouring_of_nothing():
    assert column_colouring(np.zeros((3, 0), bool)).shape == (0,)
    assert column_colouring(np.zeros((0, 3), bool)).tolist() == [0, 0, 0]


def test_chain_is_narrow_in_cuthill_mckee_order():
    pattern = shuffled(chain(60))
    assert bandwidth(pattern) > 10
    assert bandwidth(pattern, reverse_cuthill_mckee(pattern)) == 1


@pytest.mark.parametrize(
    ("pattern", "border", "width"),
    [(chain(40), 0, 1), (closed_chain(40), 1, 2), (np.ones((9, 9), bool), 0, 8), (np.eye(4, dtype=bool), 0, 0)],
)
def test_bordered_order(pattern, border, width):
    pattern = shuffled(pattern)
    order = bordered_order(pattern)
    assert sorted(order.permutation) == list(range(len(pattern)))
    assert len(order.border) <= border
    assert order.bandwidth == bandwidth(pattern, order.interior) <= width


def test_dense_rows_go_to_the_border():
    pattern = chain(40)
    for row in (7, 20):
        pattern[row], pattern[:, row] = True, True
    order = bordered_order(pattern)
    assert set(order.border.tolist()) == {7, 20}
    assert order.bandwidth == 1
