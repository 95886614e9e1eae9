"""Sparse factors against dense ones of numpy: known pivots, and partial pivoting where these are small."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array, random_array

from dae_jax import configure
from dae_jax.linalg.sparse import Sparse
from dae_jax.linalg.symbolic_lu import symbolic_lu


def example(n=60, density=0.05, dtype=np.float64, seed=0):
    """A pattern whose equations are paired with variables in no order, and numbers for it."""
    rng = np.random.default_rng(seed)
    pairing = rng.permutation(n)
    matrix = csr_array((random_array((n, n), density=density, rng=rng) + 3 * eye_array(n)).tocsr()[pairing])
    matrix.sort_indices()
    rows, columns = matrix.nonzero()
    entries = matrix.data * rng.uniform(0.5, 1, len(rows))
    if np.issubdtype(dtype, np.complexfloating):
        entries = entries + 1j * rng.normal(size=len(rows))
    of_rates = rng.uniform(size=len(rows)) < 0.5
    return Sparse(rows, columns, pairing, of_rates), jnp.asarray(entries, dtype), rng


def dense(storage, entries):
    found = np.zeros((storage.size, storage.size), entries.dtype)
    found[storage.rows, storage.columns] = entries
    return found


def solve(storage, entries, b):
    return storage.solve(storage.factor(entries), b)


@pytest.mark.parametrize("dtype", [np.float64, np.complex128, np.float32])
@pytest.mark.parametrize("n", [1, 7, 60])
def test_solves_with_the_matrix_and_with_its_transpose(n, dtype):
    storage, a, rng = example(n, dtype=dtype)
    b = jnp.asarray(rng.normal(size=n), dtype)
    tolerance = 1e4 * np.finfo(dtype).eps
    matrix = dense(storage, np.asarray(a))
    np.testing.assert_allclose(matrix @ solve(storage, a, b), b, atol=tolerance)
    (transposed,) = jax.linear_transpose(lambda b: solve(storage, a, b), b)(b)
    np.testing.assert_allclose(matrix.T @ transposed, b, atol=tolerance)
    np.testing.assert_allclose(storage.apply(a, b), matrix @ b, rtol=tolerance, atol=tolerance)


def test_a_right_hand_side_may_be_real_where_the_matrix_is_complex():
    storage, a, rng = example(dtype=np.complex128)
    b = rng.normal(size=storage.size)
    np.testing.assert_allclose(dense(storage, np.asarray(a)) @ solve(storage, a, jnp.asarray(b)), b, atol=1e-12)


def with_small_pivots(size, n=40):
    """Pairs of equations in pairs of variables, [[size, 1], [1, size]], paired along the diagonal."""
    first = np.arange(0, n, 2)
    rows = np.concatenate([first, first, first + 1, first + 1])
    columns = np.concatenate([first, first + 1, first, first + 1])
    entries = np.concatenate([np.full(n // 2, size), np.ones(n), np.full(n // 2, size)])
    order = np.lexsort((columns, rows))
    storage = Sparse(rows[order], columns[order], np.arange(n), np.ones(2 * n, bool))
    return storage, jnp.asarray(entries[order])


@pytest.mark.parametrize("size", [0.0, 1e-14, 1e-7])
def test_small_pivots_are_left_to_partial_pivoting(size):
    storage, a = with_small_pivots(size)
    assert storage.factor(a)[2] == (size < 1e-6)
    b = jnp.arange(1.0, 41.0)
    found = jax.jit(lambda a, b: solve(storage, a, b))
    np.testing.assert_allclose(dense(storage, a) @ found(a, b), b, rtol=1e-8)
    (transposed,) = jax.linear_transpose(lambda b: found(a, b), b)(b)
    np.testing.assert_allclose(dense(storage, a).T @ transposed, b, rtol=1e-8)
    both = jax.vmap(found)(jnp.stack([a, with_small_pivots(5.0)[1]]), jnp.stack([b, b]))
    np.testing.assert_allclose(both[0], found(a, b))
    np.testing.assert_allclose(dense(storage, with_small_pivots(5.0)[1]) @ both[1], b, rtol=1e-12)


def test_a_singular_matrix_has_no_solution():
    storage, a, _ = example()
    for entries in (0 * a, a.at[storage.rows == 5].set(0), jnp.full_like(a, jnp.nan)):
        assert jnp.isnan(solve(storage, entries, jnp.ones(storage.size))).all()


def test_without_our_compiler_partial_pivoting_does_it_all():
    import dae_jax

    storage, a, rng = example()
    b = jnp.asarray(rng.normal(size=storage.size))
    with dae_jax.configure(compiler="off"):
        factors = storage.factor(a)
        assert factors[1] is None
        np.testing.assert_allclose(dense(storage, a) @ storage.solve(factors, b), b, atol=1e-12)


def test_derivatives_by_matrix_and_right_hand_side():
    storage, a, rng = example(20)
    b, da, db, w = (jnp.asarray(rng.normal(size=x.size)) for x in (jnp.ones(20), a, jnp.ones(20), jnp.ones(20)))
    step = 1e-6
    difference = (solve(storage, a + step * da, b + step * db) - solve(storage, a - step * da, b - step * db)) / (
        2 * step
    )
    of = lambda a, b: solve(storage, a, b)
    np.testing.assert_allclose(jax.jvp(of, (a, b), (da, db))[1], difference, rtol=1e-6, atol=1e-8)
    of_a, of_b = jax.vjp(of, a, b)[1](w)
    np.testing.assert_allclose(of_a @ da + of_b @ db, w @ difference, rtol=1e-6)


def test_a_batch_is_one_after_the_other():
    storage, a, rng = example(20)
    many, b = jnp.asarray(rng.uniform(1, 2, (5, 1))) * a, jnp.asarray(rng.normal(size=(5, 20)))
    # To the last bit where both fuse products with sums.
    with configure(optimise=True):
        alone = [solve(storage, x, y) for x, y in zip(many, b, strict=True)]
        np.testing.assert_array_equal(jax.vmap(lambda a, b: solve(storage, a, b))(many, b), jnp.stack(alone))
    np.testing.assert_allclose(
        jax.vmap(lambda b: solve(storage, a, b))(b), jnp.stack([solve(storage, a, y) for y in b]), rtol=1e-14
    )


def test_coupled_copies():
    storage, a, rng = example(12)
    parts, others = [a, 2 * a], [jnp.where(storage.of_rates, x, 0) for x in (a, -a)]
    weights = rng.normal(size=(2, 2))
    both, entries = storage.coupled(parts, others, jnp.asarray(weights))
    whole = np.zeros((24, 24))
    for i in range(2):
        for j in range(2):
            whole[i::2, j::2] = (i == j) * dense(storage, parts[i]) + weights[i, j] * dense(storage, others[i])
    np.testing.assert_allclose(dense(both, entries), whole)
    b = rng.normal(size=24)
    np.testing.assert_allclose(whole @ solve(both, entries, jnp.asarray(b)), b, atol=1e-10)


def test_least_squares_of_a_singular_matrix_repeated():
    storage, a, rng = example(20)
    a = a.at[storage.columns == 3].set(0)
    b = jnp.asarray(rng.normal(size=20))
    x = jnp.zeros(20)
    for _ in range(3):
        x = x + storage.least_squares(a, b - storage.apply(a, x))
    scale = 1 / np.abs(dense(storage, a)).max(1)
    best = np.linalg.lstsq(scale[:, None] * dense(storage, a), scale * b, rcond=1e-10)[0]
    np.testing.assert_allclose(x, best, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_the_fill_is_that_of_the_elimination(seed):
    storage, *_ = example(30, 0.08, seed=seed)
    found = symbolic_lu(storage.rows, storage.columns, storage.pairing)
    paired = np.zeros((30, 30), bool)
    paired[storage.pairing[storage.rows], storage.columns] = True
    pattern = (paired | paired.T | np.eye(30, dtype=bool))[np.ix_(found.columns, found.columns)]
    for k in range(30):
        pattern |= np.outer(pattern[:, k] & (np.arange(30) > k), pattern[k] & (np.arange(30) > k))
    there = np.zeros((30, 30), bool)
    there[np.repeat(np.arange(30), np.diff(found.start)), found.at] = True
    np.testing.assert_array_equal(there, pattern)
    below = np.tril(pattern, -1)
    assert found.cost == sum(np.triu(pattern, 1)[below[i]].sum() for i in range(30))


def test_no_fill_underflows_in_a_long_chain():
    """What is found by an elimination with numbers must not vanish: a ring of 50,000, eliminated to its last two."""
    n = 50_000
    rows = np.repeat(np.arange(n), 3)
    columns = (rows + np.tile([-1, 0, 1], n)) % n
    found = symbolic_lu(rows, columns, np.arange(n))
    # Each unknown has two neighbours when it is eliminated, but the last two.
    assert len(found.at) == n + 2 * (2 * n - 3)
