"""Systems written with a few operations on long arrays: their patterns, and work that grows with the number of nonzeros."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from jax import lax

import dae_jax
from dae_jax.equations.derivative_orders import find_offsets
from dae_jax.equations.residual_form import ResidualForm
from dae_jax.equations.slopes import Slopes
from dae_jax.linalg.rank import is_nonsingular
from dae_jax.structure import (
    Block,
    column_colouring,
    dependence_patterns,
    incidence,
    is_linear,
    maximum_matching,
    sigma_method,
    variables_of,
)
from dae_jax.structure.sets import Sets


STENCIL = np.array([[0.0, 1, 0], [1, -4, 1], [0, 1, 0]])


def robertson(n):
    """n copies."""

    def residual(y, yd):
        y, yd = y.reshape(3, -1), yd.reshape(3, -1)
        r, s = 0.04 * y[0] - 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return jnp.concatenate([yd[0] + r, yd[1] - r + s, y.sum(0) - 1])

    return residual, 3 * n


def heat(laplacian):
    def of(n):
        side = int(np.sqrt(n))
        return lambda y, yd: yd - laplacian(y.reshape(side, side)).reshape(-1), side**2

    return of


def by_pad(u):
    p = jnp.pad(u, 1)
    return p[2:, 1:-1] + p[:-2, 1:-1] + p[1:-1, 2:] + p[1:-1, :-2] - 4 * u


def by_slices(u):
    inner = u[2:, 1:-1] + u[:-2, 1:-1] + u[1:-1, 2:] + u[1:-1, :-2] - 4 * u[1:-1, 1:-1]
    return jnp.zeros_like(u).at[1:-1, 1:-1].set(inner)


def by_roll(u):
    return sum(jnp.roll(u, step, axis) for step in (1, -1) for axis in (0, 1)) - 4 * u


def by_matrix(u):
    second = jnp.asarray(np.diff(np.eye(len(u) + 2), 2, axis=0)[:, 1:-1])
    return second @ u + u @ second.T


def by_convolution(u):
    return lax.conv_general_dilated(u[None, None], jnp.asarray(STENCIL)[None, None], (1, 1), "SAME")[0, 0]


def by_scan(u):
    """Row by row."""
    above, below = jnp.pad(u, ((1, 0), (0, 0)))[:-1], jnp.pad(u, ((0, 1), (0, 0)))[1:]
    return lax.map(
        lambda rows: rows[0] + rows[2] + jnp.convolve(rows[1], np.array([1.0, -4, 1]), "same"), (above, u, below)
    )


def food_web(n):
    """Prey and predators, the latter in equilibrium, that diffuse on a square."""
    side = int(np.sqrt(n))
    shares = np.array([[-1.0, -0.5e-6], [1e4, -1.0]])

    def residual(y, yd):
        c, rate = y.reshape(2, side, side), yd.reshape(2, side, side)
        p = jnp.pad(c, ((0, 0), (1, 1), (1, 1)), mode="reflect")
        spread = p[:, 2:, 1:-1] + p[:, :-2, 1:-1] + p[:, 1:-1, 2:] + p[:, 1:-1, :-2] - 4 * c
        right = spread + c * (1 + jnp.einsum("ij,jkl->ikl", shares, c))
        return jnp.concatenate([(rate[0] - right[0]).ravel(), right[1].ravel()])

    return residual, 2 * side**2


def lines(n):
    """A ring of n nodes and some chords: from, to, and how many nodes have a machine."""
    rng = np.random.default_rng(1)
    start, end = np.arange(n), (np.arange(n) + 1 + rng.integers(0, n - 2, n) * (rng.random(n) < 0.3)) % n
    order = rng.permutation(n)
    return order[start], order[end], n // 3


def power_grid(inject):
    """Swing equations at some nodes, the balance of power at the others."""

    def of(n):
        start, end, machines = lines(n)

        def residual(y, yd):
            angle, speed = y[:n], y[n:]
            balance = 0.1 - inject(jnp.sin(angle[start] - angle[end]), start, end, n)
            swing = yd[n:] + speed - balance[:machines]
            return jnp.concatenate([yd[:machines] - speed, swing, balance[machines:]])

        return residual, n + machines

    return of


def by_at(flow, start, end, n):
    return jnp.zeros(n).at[start].add(flow).at[end].add(-flow)


def by_segments(flow, start, end, n):
    return jax.ops.segment_sum(flow, jnp.asarray(start), n) - jax.ops.segment_sum(flow, jnp.asarray(end), n)


def sparse_product(n):
    """Gather, multiply, sum."""
    matrix = scipy.sparse.random_array((n, n), density=3 / n, rng=np.random.default_rng(2), format="coo")
    rows, columns = matrix.coords

    def residual(y, yd):
        return yd + y - jax.ops.segment_sum(matrix.data * y[columns], jnp.asarray(rows), n) ** 2

    return residual, n


def ladder(n):
    """Capacitors, diodes and resistors in a chain."""

    def residual(y, yd):
        v, w, i = y.reshape(3, -1)
        before = jnp.concatenate([jnp.ones(1), v[:-1]])
        rate = yd.reshape(3, -1)[0]
        return jnp.concatenate([rate - i + v, i - jnp.expm1(w - v), before - w - i])

    return residual, 3 * n


def held_integral(n):
    """Heat on a rod, with a source that holds its integral: one equation of all variables."""

    def residual(y, yd):
        u, source = y[:-1], y[-1]
        p = jnp.pad(u, 1)
        return jnp.concatenate([yd[:-1] - (p[2:] + p[:-2] - 2 * u) - source, jnp.sum(u)[None] - 1])

    return residual, n + 1


def pendula(n):
    def residual(y, yd):
        (x, z, u, v, tension), (xd, zd, ud, vd, _) = y.reshape(5, -1), yd.reshape(5, -1)
        return jnp.concatenate([xd - u, zd - v, ud + tension * x, vd + tension * z + 9.81, x * x + z * z - 1])

    return residual, 5 * n


SYSTEMS = {
    "robertson": robertson,
    "heat by pad": heat(by_pad),
    "heat by slices": heat(by_slices),
    "heat by roll": heat(by_roll),
    "heat by matrix": heat(by_matrix),
    "heat by convolution": heat(by_convolution),
    "heat by scan": heat(by_scan),
    "food web": food_web,
    "power grid by at": power_grid(by_at),
    "power grid by segments": power_grid(by_segments),
    "sparse product": sparse_product,
    "ladder": ladder,
    "held integral": held_integral,
    "pendula": pendula,
}
# Index, degrees of freedom for n, and blocks.
FOUND = {
    "robertson": (1, lambda n: 2 * n),
    "heat by convolution": (0, lambda n: n),
    "power grid by at": (1, lambda n: 2 * (n // 3)),
    "ladder": (1, lambda n: n),
    "held integral": (2, lambda n: n - 1),
    "pendula": (3, lambda n: 2 * n),
}


def system(name, n):
    residual, size = SYSTEMS[name](n)
    return dae_jax.ImplicitDAE(lambda t, y, yd, args: residual(y, yd)), size


def patterns(name, n):
    residual, size = SYSTEMS[name](n)
    return dependence_patterns(residual, jnp.ones(size), jnp.ones(size), derivative=True)


@pytest.mark.parametrize("name", SYSTEMS)
def test_pattern_is_that_of_the_jacobian(name):
    residual, size = SYSTEMS[name](25)
    points = np.random.default_rng(0).normal(size=(3, 2, size))
    for argument, pattern in enumerate(patterns(name, 25)):
        jacobians = jax.vmap(jax.jacfwd(residual, argument))(points[:, 0], points[:, 1])
        np.testing.assert_array_equal(pattern.toarray(), np.any(np.asarray(jacobians) != 0, 0))
        assert pattern.has_sorted_indices


@pytest.mark.parametrize("name", SYSTEMS)
def test_sets_grow_with_the_number_of_entries(name, monkeypatch):
    made = []

    class Noted(Sets):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            made.append(self)

    monkeypatch.setattr(incidence, "Sets", Noted)
    for n in (400, 900):
        patterns(name, n)
    assert len(made[1]) / len(made[0]) <= 1.1 * 900 / 400


@pytest.mark.parametrize("name", FOUND)
def test_structure_of_hundreds_of_equations(name):
    n = 400
    index, freedom = FOUND[name]
    residual, size = system(name, n)
    found = dae_jax.analyse(residual, 0.0, 0.1 + 0.01 * jnp.arange(size))
    assert (found.index, found.degrees_of_freedom, found.regular) == (index, freedom(n), True)
    assert sum(len(block.equations) for block in found.blocks) == size
    assert len(str(found)) < 500


def test_ten_thousand_copies_of_robertson():
    """In seconds; a cost that grows with the square would take hours."""
    residual, size = system("robertson", 10_000)
    found = dae_jax.analyse(residual, 0.0, jnp.ones(size))
    assert (found.index, found.degrees_of_freedom, found.regular) == (1, 20_000, True)
    assert "30000 blocks of 1 equation" in str(found)
    assert len(found.hidden_constraints()) == 0


def test_many_singular_equations_are_named_in_short():
    def residual(t, y, yd, args):
        x, rate = y.reshape(3, -1), yd.reshape(3, -1)
        return jnp.concatenate([rate[0] + x[1], x[0] - 1, x[0] ** 2 + rate[0]])

    with pytest.raises(ValueError, match=r"residual\[1007\] and 1992 more .* y\[2007\] and 992 more") as raised:
        dae_jax.analyse(dae_jax.ImplicitDAE(residual), 0.0, jnp.ones(3000))
    assert len(str(raised.value)) < 600


def test_what_cancels_in_a_large_circuit_is_seen_by_the_rank():
    """Too many capacitors between nodes to look at one by one."""

    def residual(t, y, yd, args):
        current = yd[::2] - yd[1::2]
        stamped = jnp.zeros_like(y).at[::2].add(current).at[1::2].add(-current)
        return stamped + y + jnp.concatenate([y[:1] - jnp.sin(t), y[1:] - y[:-1]])

    assert not dae_jax.analyse(dae_jax.ImplicitDAE(residual), 0.0, jnp.zeros(6000)).regular


def test_linearity_in_one_argument_of_many_numbers():
    residual, size = SYSTEMS["robertson"](2000)
    y = jnp.ones(size)
    assert is_linear(residual, y, y, argument=1)
    assert not is_linear(residual, y, y, argument=0)


def test_slopes_of_full_equations_are_found_apart():
    """No more directions than the other equations need; the values are those of the Jacobians."""
    residual, size = SYSTEMS["held integral"](150)
    form = ResidualForm.of(dae_jax.ImplicitDAE(lambda t, y, yd, args: residual(y**2, yd)), 0.0, jnp.ones(size), None)
    found = find_offsets(form, jnp.result_type(float))
    slopes = Slopes(form.residual, found.variables, 0, jnp.result_type(float))
    assert slopes.full.tolist() == [size - 1]
    assert slopes.colours.max() < 5
    y, yd = np.random.default_rng(0).normal(size=(2, size))
    i, j = (x.reshape(-1) for x in np.indices((size, size)))
    for order, jacobian in enumerate((jax.jacfwd(form.residual, 1), jax.jacfwd(form.residual, 2))):
        values = slopes.at(jnp.zeros(()), jnp.stack([y, yd]))
        entries = slopes.entries(values, 0 * i, i, 0 * i + order, j)
        np.testing.assert_allclose(entries.reshape(size, size), jacobian(0.0, y, yd), atol=1e-12)


def test_a_full_row_has_a_colour_for_each_column():
    pattern = np.eye(2000, dtype=bool)
    pattern[7] = True
    assert column_colouring(scipy.sparse.csr_array(pattern)).tolist() == list(range(2000))


@pytest.mark.parametrize("size", [4, 400])
def test_rank_block_by_block(size):
    """Of small blocks and of ones that are factorised sparsely."""
    rng = np.random.default_rng(0)
    entries = rng.normal(size=(size, size)) * (rng.random((size, size)) < 5 / size) + np.diag(rng.uniform(2, 3, size))
    beside = np.ones((size, size))
    places = rng.permutation(2 * size)
    blocks = [Block(tuple(part), tuple(part)) for part in itertools.starmap(range, ((0, size), (size, 2 * size)))]
    permuted = [Block(tuple(places[list(b.equations)]), tuple(places[list(b.variables)])) for b in blocks]

    def regular(second):
        matrix = np.block([[entries, np.zeros((size, size))], [beside, second]])
        order = np.argsort(places)
        return is_nonsingular(scipy.sparse.csr_array(matrix[np.ix_(order, order)]), permuted, 2e-16)

    assert regular(entries)
    dependent = entries.copy()
    dependent[1] = 2 * dependent[0] + dependent[2]
    assert not regular(dependent)
    dependent[1] = np.nan
    assert not regular(dependent)


@pytest.mark.parametrize("shift", [0, 1])
def test_matching_of_a_large_grid(shift):
    """Rows and columns in random order, with long augmenting paths; of one equation too many as well."""
    side, rng = 60, np.random.default_rng(0)
    line = scipy.sparse.diags_array([np.ones(side - 1), np.ones(side), np.ones(side - 1)], offsets=[-1, 0, 1])
    own = scipy.sparse.eye_array(side)
    grid = scipy.sparse.csr_array(scipy.sparse.kron(own, line) + scipy.sparse.kron(line, own))
    order, other = rng.permutation(side**2), rng.permutation(side**2)
    rows = variables_of(scipy.sparse.csr_array(grid[order][:, other]))
    rows = rows + [[3, 4]] * shift
    matching = maximum_matching(rows, side**2)
    paired = [j for j in matching if j is not None]
    assert sorted(paired) == list(range(side**2))
    assert all(j is None or j in row for j, row in zip(matching, rows, strict=True))
    if not shift:
        assert sigma_method([dict.fromkeys(row, 0) for row in rows]).degrees_of_freedom == 0
