"""What stands in a kernel for LAPACK's factorisations, and for sorting, gives what JAX gives."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler import equations, jit
from dae_jax.compiler.jaxprs.expansions import expanded


SIZES = [1, 2, 3, 6, 8]
DTYPES = [np.float64, np.float32, np.complex128]


def matrix(*shape, dtype=np.float64):
    rng = np.random.default_rng(len(shape) + shape[-1])
    parts = rng.normal(size=(2, *shape))
    return (parts[0] + 1j * parts[1] if np.issubdtype(dtype, np.complexfloating) else parts[0]).astype(dtype)


def hermitian(n, dtype):
    a = matrix(n, n, dtype=dtype)
    return a @ a.conj().T + np.eye(n, dtype=dtype)


def assert_expanded(fn, *args):
    """The function is compiled by us, and gives what JAX gives."""
    assert jit(fn).lower(*args).compiler == "llvm"
    assert_same(jit(fn)(*args), jax.jit(fn)(*args))


def assert_same(found, expected):
    """Equal to rounding."""
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        scale = np.max(np.abs(y), initial=0, where=np.isfinite(y)) if y.dtype.kind in "fc" else 0
        np.testing.assert_allclose(x, y, rtol=0, atol=1e4 * scale * np.finfo(y.dtype).eps if scale else 0)


@pytest.mark.parametrize("n", SIZES)
def test_lu_and_what_is_made_of_it(n):
    a, b = matrix(n, n), matrix(n)
    assert_expanded(
        lambda a, b: (*jax.lax.linalg.lu(a), jnp.linalg.solve(a, b), jnp.linalg.inv(a), jnp.linalg.det(a)), a, b
    )


def test_in_loops_and_branches():
    square = lambda x: jnp.linalg.cholesky(x @ x.T + jnp.eye(3))

    def fn(a):
        turned = jax.lax.fori_loop(0, jnp.int32(a[0, 0]), lambda _, x: square(x), a)
        return jax.lax.cond(a[0, 0] > 0, lambda x: jax.lax.map(square, x[None])[0], lambda x: x, turned)

    a = 4 * np.eye(3) + matrix(3, 3)
    assert_expanded(fn, a)
    assert "cholesky" not in {eqn.primitive.name for eqn in equations(expanded(jax.make_jaxpr(fn)(a)))}


@pytest.mark.parametrize("dtype", DTYPES)
def test_factorisations_of_every_type(dtype):
    def all_of_them(a, s):
        return jax.lax.linalg.lu(a), jnp.linalg.cholesky(s), jnp.linalg.qr(a), jnp.linalg.solve(s, a)

    is_complex = np.issubdtype(dtype, np.complexfloating)
    fn = (lambda a, s: jax.lax.linalg.lu(a)) if is_complex else all_of_them
    for n in (3, 8):
        assert_expanded(fn, matrix(n, n, dtype=dtype), hermitian(n, dtype))


@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (2, 7), (9, 3), (2, 2, 3, 3), (3, 7, 7)])
def test_any_shape(shape):
    assert_expanded(lambda a: (jax.lax.linalg.lu(a), jnp.linalg.qr(a)), matrix(*shape))


def test_full_qr():
    assert_expanded(lambda a: jnp.linalg.qr(a, mode="complete"), matrix(5, 3))
    assert_expanded(lambda a: jnp.linalg.qr(a, mode="complete"), matrix(3, 5))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", ["reduced", "complete"])
def test_qr_where_squares_overflow_or_are_zero(dtype, mode):
    a = matrix(5, 3, dtype=dtype)
    limits = np.finfo(dtype)
    for size in (limits.tiny**0.9, limits.max**0.9):
        q, r = jit(lambda a: jnp.linalg.qr(a, mode=mode))(a * size)
        np.testing.assert_allclose(q @ (r / size), a, atol=100 * limits.eps)
        np.testing.assert_allclose(q.conj().T @ q, np.eye(q.shape[1]), atol=100 * limits.eps)


@pytest.mark.parametrize(
    "fn", [jnp.linalg.cholesky, jnp.linalg.qr, jnp.linalg.inv, jax.lax.linalg.lu, jnp.sort, jnp.argsort]
)
@pytest.mark.parametrize("transform", [lambda fn: fn, jax.vmap])
def test_no_entries(fn, transform):
    a = np.zeros((2, 0, 0))
    for x, y in zip(jax.tree.leaves(transform(jit(fn))(a)), jax.tree.leaves(transform(jax.jit(fn))(a)), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)


@pytest.mark.parametrize("n", [3, 8])
def test_singular_and_indefinite(n):
    singular = np.ones((n, n))
    assert_expanded(jax.lax.linalg.lu, singular)
    assert_expanded(jax.lax.linalg.lu, np.zeros((n, n)))
    assert_expanded(lambda a: jnp.isnan(jnp.linalg.cholesky(a)), -np.eye(n))
    assert_expanded(lambda a: jnp.isnan(jnp.linalg.cholesky(a)), np.full((n, n), np.nan))
    assert_expanded(lambda a: jnp.isnan(jnp.linalg.solve(a, jnp.ones(n))).any(), np.full((n, n), np.nan))


@pytest.mark.parametrize("n", [3, 5])
@pytest.mark.parametrize("value", [np.inf, np.nan])
@pytest.mark.parametrize("row", [1, -1])
def test_a_factor_beside_what_is_not_finite(n, value, row):
    """LAPACK leaves what does not depend on it."""
    a = 3 * np.eye(n) + 0.1
    a[row, row] = value
    assert_expanded(jnp.linalg.cholesky, a)


@pytest.mark.parametrize("n", [3, 8])
@pytest.mark.parametrize("flags", list(itertools.product([False, True], repeat=4)))
def test_triangular_systems(n, flags):
    left_side, lower, transpose_a, unit_diagonal = flags
    solve = lambda a, b: jax.lax.linalg.triangular_solve(
        a, b, left_side=left_side, lower=lower, transpose_a=transpose_a, unit_diagonal=unit_diagonal
    )
    # What is not part of the triangle is not looked at.
    a = matrix(n, n) + np.where(np.tri(n, dtype=bool) == lower, 0, np.nan) + 2 * np.eye(n)
    np.fill_diagonal(a, 2.0)
    assert_expanded(solve, a, matrix(n, 2) if left_side else matrix(2, n))


@pytest.mark.parametrize("dtype", DTYPES)
def test_large_ones_are_lapacks(dtype):
    n = 40
    a, b, s = matrix(n, n, dtype=dtype), matrix(n, 2, dtype=dtype), hermitian(n, dtype)
    assert_expanded(lambda a: jax.lax.linalg.lu(a), a)
    assert_expanded(lambda a, b: (jnp.linalg.solve(a, b), jnp.linalg.inv(a), jnp.linalg.slogdet(a)), a, b)
    assert_expanded(lambda s, b: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(s), True), b), s, b)
    assert_expanded(lambda a: jax.lax.linalg.lu(a), matrix(50, 7, dtype=dtype))
    assert_expanded(lambda a: jax.lax.linalg.lu(a), matrix(7, 50, dtype=dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_large_ones_of_a_batch_and_in_stacks(dtype):
    a, s = matrix(5, 40, 40, dtype=dtype), np.stack([hermitian(40, dtype) + k * np.eye(40) for k in range(5)])
    all_of_them = lambda a, s: (jax.lax.linalg.lu(a), jnp.linalg.cholesky(s), jnp.linalg.solve(s, a))
    assert_expanded(all_of_them, a, s)
    assert_same(jax.vmap(jit(all_of_them))(a, s), jax.vmap(all_of_them)(a, s))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [0, 1, 5, 40])
def test_eigenvalues_and_eigenvectors_are_those_that_jax_gives(dtype, n):
    """By the same function, so that signs are the same, and which half is looked at; of stacks and in lanes too."""
    a = matrix(3, n, n, dtype=dtype)
    for lower in (True, False):
        decomposed = functools.partial(jax.lax.linalg.eigh, lower=lower, symmetrize_input=False)
        assert jit(decomposed).lower(a[0]).compiler == "llvm"
        assert_expanded(decomposed, a[0])
        assert_expanded(decomposed, a)
        assert_same(jax.vmap(jit(decomposed))(a), jax.vmap(decomposed)(a))


def test_eigenvalues_of_what_is_not_a_number_are_none():
    assert_expanded(jnp.linalg.eigh, np.full((4, 4), np.nan))


def test_some_eigenvalues_are_left_to_jax():
    some = lambda a: jax.lax.linalg.eigh(a, subset_by_index=(0, 2))
    (reason,) = jit(some).lower(np.eye(4)).unsupported
    assert reason.primitive == "eigh"
    assert "some of the eigenvalues" in str(reason)


def test_large_ones_in_the_lanes_that_ask_for_them():
    """Lane k is solved k times, and what it has in other turns stays."""
    n = 36
    a = matrix(n, n) + n * np.eye(n)

    def loop(turns, x):
        solved = lambda k, x: jax.lax.cond(k < turns, lambda: n * jnp.linalg.solve(a + k * jnp.diag(x), x), lambda: x)
        return jax.lax.fori_loop(0, 5, solved, x)

    turns, x = np.arange(11) % 6, np.random.default_rng(0).uniform(1, 2, (11, n))
    assert_same(jax.vmap(jit(loop))(turns, x), jnp.stack([loop(t, y) for t, y in zip(turns, x, strict=True)]))


@pytest.mark.parametrize("dtype", ["float64", "complex128"])
@pytest.mark.parametrize("flags", list(itertools.product([False, True], repeat=5)))
def test_large_triangular_systems(dtype, flags):
    left_side, lower, transpose_a, conjugate_a, unit_diagonal = flags
    n = 35
    solve = lambda a, b: jax.lax.linalg.triangular_solve(
        a,
        b,
        left_side=left_side,
        lower=lower,
        transpose_a=transpose_a,
        conjugate_a=conjugate_a,
        unit_diagonal=unit_diagonal,
    )
    a = matrix(n, n, dtype=dtype) / n + 2 * np.eye(n)
    b = matrix(n, 2, dtype=dtype) if left_side else matrix(2, n, dtype=dtype)
    assert_expanded(solve, a, b)
    # By columns, as an LU is.
    assert_expanded(lambda a, b: solve(jax.lax.linalg.lu(a)[0], b), a, b)


def test_large_ones_that_are_singular():
    n = 40
    singular = np.tile(matrix(n, 1), (1, n))
    assert_expanded(jax.lax.linalg.lu, np.zeros((n, n)))
    assert_expanded(lambda a: jnp.isnan(jnp.linalg.cholesky(a)), -np.eye(n))
    assert_expanded(lambda a: jnp.isnan(jnp.linalg.solve(a, np.full(n, np.nan))), singular)


def test_large_ones_have_derivatives():
    n = 40
    a = matrix(n, n) + n * np.eye(n)
    fn = lambda a: jnp.sum(jnp.sin(jnp.linalg.solve(a, jnp.ones(n))))
    np.testing.assert_allclose(jax.grad(jit(fn))(a), jax.grad(fn)(a), rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(jax.jvp(jit(fn), (a,), (a,))[1], jax.jvp(fn, (a,), (a,))[1], rtol=1e-10)


NUMBERS = np.array([3.0, np.nan, -0.0, 0.0, np.inf, -np.inf, 1.0, 1.0, -2.5])


@pytest.mark.parametrize(
    "x",
    [
        NUMBERS,
        NUMBERS.astype(np.float32),
        np.array([1, 2**31 + 5, 7], np.uint32),
        np.array([3, -1, 2]),
        np.array([True, False]),
    ],
)
def test_sorting_in_every_order(x):
    for fn in (jnp.sort, jnp.argsort, lambda x: jnp.sort(x, descending=True)):
        np.testing.assert_array_equal(jit(fn)(x), jax.jit(fn)(x))
    assert jit(jnp.sort).lower(x).compiler == "llvm"


def test_sorting_by_several_keys_along_an_axis():
    fn = lambda x: jax.lax.sort((x // 2, x, jnp.broadcast_to(jnp.arange(3.0), x.shape)), dimension=0, num_keys=2)
    x = np.arange(12.0)[::-1].reshape(4, 3) % 5
    for a, b in zip(jit(fn)(x), jax.jit(fn)(x), strict=True):
        np.testing.assert_array_equal(a, b)
    long = np.random.default_rng(0).normal(size=200).round(1)
    np.testing.assert_array_equal(jit(jnp.argsort)(long), jax.jit(jnp.argsort)(long))
    assert "sort of more than" in str(jit(jnp.sort).lower(np.zeros(5000)))
