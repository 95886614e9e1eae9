"""GMRES alone: matrices of which products are known, and its storage beside the factors of another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import GMRES
from dae_jax.linalg.gmres import gmres
from dae_jax.linalg.iterative import Iterative
from dae_jax.linalg.sparse import Sparse
from dae_jax.linalg.storage import Banded, Dense


def matrix(n, dtype=float, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n)) / np.sqrt(n) + 3 * np.eye(n)
    b = rng.standard_normal(n)
    if np.issubdtype(dtype, np.complexfloating):
        a, b = a + 1j * rng.standard_normal((n, n)) / np.sqrt(n), b + 1j * rng.standard_normal(n)
    return jnp.asarray(a, dtype), jnp.asarray(b, dtype)


def solved(a, b, rtol=1e-10, restart=30, most=1000, precondition=lambda v: v):
    return gmres(lambda v: a @ v, precondition, b, rtol=rtol, restart=restart, most=most)


class TestMethod:
    @pytest.mark.parametrize("dtype", [float, complex, np.float32, np.complex64])
    @pytest.mark.parametrize("restart", [1, 30])
    @pytest.mark.parametrize("n", [1, 40])
    def test_leaves_what_it_may(self, dtype, restart, n):
        a, b = matrix(n, dtype)
        rtol = 1e-10 if jnp.finfo(dtype).bits == 64 else 1e-5
        x, well = jax.jit(lambda b: solved(a, b, rtol, restart))(b)
        assert well
        assert jnp.linalg.norm(a @ x - b) <= 1.1 * rtol * jnp.linalg.norm(b)
        assert x.dtype == dtype

    def test_ends_after_as_many_products_as_there_are_unknowns(self):
        a, b = matrix(12)
        assert solved(a, b, rtol=1e-12, most=12)[1]
        assert not solved(a, b, rtol=1e-12, most=11)[1]

    def test_a_good_preconditioner_leaves_nothing_to_do(self):
        a, b = matrix(40)
        assert solved(a, b, restart=1, most=1, precondition=lambda v: jnp.linalg.solve(a, v))[1]

    def test_nothing_on_the_right(self):
        a, b = matrix(4)
        x, well = solved(a, 0 * b)
        assert well
        assert np.array_equal(x, np.zeros(4))

    @pytest.mark.parametrize("of", [lambda a, b: (a.at[3].set(a[2]), b), lambda a, b: (a, b.at[0].set(jnp.nan))])
    def test_says_where_there_is_no_solution(self, of):
        assert not solved(*of(*matrix(10)))[1]

    def test_in_batches_as_one_at_a_time(self):
        a, b = matrix(20)
        many = jnp.stack([b, 0 * b, b[::-1]])
        x, well = jax.vmap(lambda b: solved(a, b))(many)
        assert well.all()
        for k, right in enumerate(many):
            np.testing.assert_allclose(x[k], solved(a, right)[0], atol=1e-12)


def grid(n=8):
    """(rows, columns, entries) of a Laplacian less the identity on n × n points."""
    line = np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    a = np.kron(line, np.eye(n)) + np.kron(np.eye(n), line) - np.eye(n * n)
    rows, columns = a.nonzero()
    return rows, columns, a[rows, columns]


class TestStorage:
    @pytest.fixture
    def sparse(self):
        rows, columns, _ = grid()
        return Sparse(rows, columns, np.arange(64), rows == columns)

    @pytest.mark.parametrize("complex_", [False, True])
    def test_solves_as_factors_do_with_derivatives(self, sparse, complex_):
        *_, entries = grid()
        a = jnp.asarray(entries * (1 + 0.3j) if complex_ else entries)
        b = jnp.sin(jnp.arange(64.0))
        by_gmres = Iterative(sparse, GMRES(rtol=1e-12))

        def size(storage):
            found = lambda a: storage.solve(storage.factor(a), b)
            return lambda a: jnp.sum(jnp.abs(found(a)) ** 2 * jnp.arange(64))

        for way in (lambda f: f, jax.grad, lambda f: lambda a: jax.jvp(f, (a,), (a * jnp.cos(jnp.arange(len(a))),))[1]):
            by_factors = way(size(sparse))(a)
            np.testing.assert_allclose(
                way(size(by_gmres))(a), by_factors, rtol=1e-9, atol=1e-9 * jnp.abs(by_factors).max()
            )

    @pytest.mark.parametrize("inner", [Dense(40), Banded(np.arange(40), np.arange(40)[::-1].copy(), 2, 1)])
    def test_takes_any_storage(self, inner):
        rows, columns = inner.positions()
        rng = np.random.default_rng(1)
        strong = np.asarray(columns) == (rows if isinstance(inner, Dense) else 39 - rows)
        a = jnp.asarray(np.where(columns < 0, 0, rng.standard_normal(rows.shape) / 4 + 3 * strong))
        b = jnp.asarray(rng.standard_normal(40))
        storage = Iterative(inner, GMRES())
        np.testing.assert_allclose(storage.apply(a, storage.solve(storage.factor(a), b)), b, atol=1e-8)

    def test_one_that_is_singular_gives_no_number(self, sparse):
        *_, entries = grid()
        storage = Iterative(sparse, GMRES())
        a = jnp.where(np.isin(sparse.rows, (3, 4)), 0.0, entries)
        assert jnp.isnan(storage.solve(storage.factor(a), jnp.ones(64))).all()

    def test_equations_in_any_order(self, sparse):
        """The incomplete factors have their pivots where the matrix has its large entries."""
        rows, columns, entries = grid()
        mixed = np.random.default_rng(2).permutation(64)
        order = np.argsort(mixed[rows], kind="stable")
        other = Sparse(mixed[rows][order], columns[order], np.argsort(mixed), (rows == columns)[order])
        a, b = jnp.asarray(entries[order]), jnp.sin(jnp.arange(64.0))
        storage = Iterative(other, GMRES(most=20))
        x = storage.solve(storage.factor(a), b[np.argsort(mixed)])
        np.testing.assert_allclose(x, sparse.solve(sparse.factor(jnp.asarray(entries)), b), atol=1e-9)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"rtol": 0.0}, "`rtol` must be a positive number"),
        ({"drop": -1.0}, "`drop` must be a positive number"),
        ({"restart": 0}, "`restart` must be a whole number of at least 1"),
        ({"most": 2.5}, "`most` must be a whole number of at least 1"),
        ({"preconditioner": 3}, "`preconditioner` must be a function of the matrix"),
    ],
)
def test_wrong_input(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        GMRES(**given)
