"""Sparse definite systems whose graph is no tree, against dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler.jaxprs.walk import equations
from dae_jax.linalg import SparseDefinite


LEGS, BLOCK, SHARED = 5, 6, 4


def pattern():
    """Legs of dense blocks that meet in one body, as those of a platform."""
    n = LEGS * BLOCK + SHARED
    found = np.zeros((n, n), bool)
    for k in range(LEGS):
        own = [*range(k * BLOCK, (k + 1) * BLOCK), *range(LEGS * BLOCK, n)]
        found[np.ix_(own, own)] = True
    return found


DEFINITE = SparseDefinite.of(pattern())


def matrix(seed, dtype=np.float64):
    """A definite one, badly scaled."""
    rng = np.random.default_rng(seed)
    half = np.tril(np.where(pattern(), rng.normal(size=pattern().shape), 0))
    scale = 10.0 ** rng.uniform(-2, 2, len(half))
    full = half @ half.T + 3 * np.eye(len(half))
    full = np.where(pattern(), full, 0) + 10 * np.eye(len(half))
    return (full * scale * scale[:, None]).astype(dtype)


def entries(a):
    return jnp.diagonal(a), a[DEFINITE.rows, DEFINITE.columns]


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-11), (np.float32, 1e-3)])
def test_equals_numpy(dtype, tolerance):
    a, x = matrix(1, dtype), np.random.default_rng(2).normal(size=len(pattern())).astype(dtype)
    x = x / np.sqrt(np.diagonal(a))
    found = jax.jit(lambda a, b: DEFINITE.solve(*entries(a), b))(a, a @ x)
    assert found.dtype == dtype
    np.testing.assert_allclose(found * np.sqrt(np.diagonal(a)), x * np.sqrt(np.diagonal(a)), atol=tolerance)


def test_a_batch_equals_one_at_a_time():
    many = np.stack([matrix(k) for k in range(11)])
    b = np.random.default_rng(3).normal(size=many.shape[:2])
    solve = lambda a, b: DEFINITE.solve(*entries(a), b)
    np.testing.assert_allclose(
        jax.jit(jax.vmap(solve))(many, b), np.linalg.solve(many, b[..., None])[..., 0], rtol=1e-9
    )


def test_derivatives_are_those_of_a_dense_solve():
    a, b = jnp.asarray(matrix(4)), jnp.asarray(np.random.default_rng(5).normal(size=len(pattern())))
    sparse = lambda a, b: jnp.sum(jnp.sin(DEFINITE.solve(*entries((a + a.T) / 2), b)))
    dense = lambda a, b: jnp.sum(jnp.sin(jnp.linalg.solve((a + a.T) / 2, b)))
    direction = jnp.asarray(matrix(6)) / 1e3, b[::-1]
    np.testing.assert_allclose(jax.jvp(sparse, (a, b), direction)[1], jax.jvp(dense, (a, b), direction)[1], rtol=1e-9)
    for found, wanted in zip(jax.grad(sparse, (0, 1))(a, b), jax.grad(dense, (0, 1))(a, b), strict=True):
        wanted = jnp.where(pattern(), wanted, 0) if wanted.ndim == 2 else wanted
        np.testing.assert_allclose(found, wanted, atol=1e-11 * jnp.abs(wanted).max())


@pytest.mark.parametrize("place", [0, LEGS * BLOCK])
def test_what_is_not_definite_gives_nan(place):
    a = matrix(7)
    a[place, place] *= -1
    assert np.isnan(DEFINITE.solve(*entries(jnp.asarray(a)), jnp.ones(len(a)))).all()
    singular = matrix(7)
    singular[place + 1], singular[:, place + 1] = singular[place], singular[:, place]
    singular[place + 1, place + 1] = singular[place, place]
    assert np.isnan(DEFINITE.solve(*entries(jnp.asarray(singular)), jnp.ones(len(a)))).all()


def test_no_dense_factorisation_and_little_work():
    a = jnp.asarray(matrix(1))
    names = {e.primitive.name for e in equations(jax.make_jaxpr(lambda a, b: DEFINITE.solve(*entries(a), b))(a, a[0]))}
    assert not names & {"cholesky", "lu"}
    assert DEFINITE.symbolic.cost < len(a) ** 3 / 10


def sparse_example(seed, n=40):
    """A random sparse definite matrix."""
    rng = np.random.default_rng(seed)
    half = np.where(rng.random((n, n)) < 2.5 / n, rng.normal(size=(n, n)), 0)
    return SparseDefinite.of(half @ half.T != 0), half @ half.T + np.diag(rng.uniform(0.5, 2, n)), rng


@pytest.mark.parametrize("seed", range(6))
def test_random_patterns_equal_numpy_with_derivatives(seed):
    definite, a, rng = sparse_example(seed)
    b = rng.normal(size=len(a))
    solve = lambda a, b: definite.solve(jnp.diagonal(a), a[definite.rows, definite.columns], b)
    x = np.linalg.solve(a, b)
    np.testing.assert_allclose(jax.jit(solve)(a, b), x, rtol=1e-10, atol=1e-12)
    # dx = S⁻¹ (db − dS x), and the transpose of that.
    weights, db = rng.normal(size=(2, len(a)))
    y = np.linalg.solve(a, weights)
    d_couplings, d_b = jax.grad(lambda c, b: weights @ definite.solve(jnp.diagonal(a), c, b), (0, 1))(
        a[definite.rows, definite.columns], b
    )
    np.testing.assert_allclose(d_b, y, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(
        d_couplings, -(np.outer(y, x) + np.outer(x, y))[definite.rows, definite.columns], rtol=1e-8, atol=1e-10
    )
    np.testing.assert_allclose(
        jax.jvp(lambda b: solve(a, b), (b,), (db,))[1], np.linalg.solve(a, db), rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_factor_is_that_of_the_permuted_matrix(seed):
    definite, a, _ = sparse_example(seed)
    k, n = definite.symbolic, len(a)
    u, regular = definite.factors(jnp.diagonal(a), a[definite.rows, definite.columns])
    assert regular
    dense = np.zeros((n, n))
    dense[np.repeat(np.arange(n), np.diff(k.start)), k.at] = u
    pivots = 1 / np.diagonal(dense)
    upper = np.triu(dense, 1) + np.diag(pivots)
    np.testing.assert_allclose(upper.T / pivots @ upper, a[np.ix_(k.order, k.order)], rtol=1e-12, atol=1e-12)
    after = np.diff(k.start.astype(int)) - 1
    assert k.cost == sum(after * (after + 1) // 2)


def test_rows_of_one_pattern_are_subtracted_together():
    k = DEFINITE.symbolic
    together, alone = k.many_start[-1], k.alone_start[-1]
    assert together > 0
    assert 4 * together + alone == len(k.at) - len(k.order)
