"""Linear and nonlinear equations against numpy and closed forms."""

import jax
import jax.numpy as jnp
import jax.test_util
import lineax
import numpy as np
import optimistix
import pytest

from dae_jax.compiler import unsupported
from dae_jax.compiler.jaxprs.walk import equations
from dae_jax.linalg import (
    SmallCholesky,
    SmallLU,
    determinant_sign,
    elimination,
    factorised,
    newton,
    rms_norm,
    semidefinite_solve,
    solve,
    solve_with,
    tearing,
)
from dae_jax.linalg.semidefinite import LOOPED, UNROLLED


# Straight-line code, a loop over columns, LAPACK.
SIZES = [1, 3, UNROLLED, UNROLLED + 1, 20, LOOPED, LOOPED + 1]
ONE_OF_EACH = [4, UNROLLED + 2, LOOPED + 1]


def definite(m, seed=0):
    A = np.random.default_rng(seed).normal(size=(m, m))
    return A @ A.T + m * np.eye(m)


def semidefinite(m, rank, seed=0):
    A = np.random.default_rng(seed).normal(size=(m, rank))
    return A @ A.T


def right(*shape, seed=1):
    return np.random.default_rng(seed).normal(size=shape)


def directional(fn, args, directions, h=1e-6):
    """The derivative of a numpy function by central differences."""
    ahead = fn(*(a + h * d for a, d in zip(args, directions, strict=True)))
    behind = fn(*(a - h * d for a, d in zip(args, directions, strict=True)))
    return (ahead - behind) / (2 * h)


class TestSemidefiniteSolve:
    @pytest.mark.parametrize("columns", [(), (3,)], ids=["vector", "matrix"])
    @pytest.mark.parametrize("m", SIZES)
    def test_equals_numpy(self, m, columns):
        S, b = definite(m), right(m, *columns)
        x = semidefinite_solve(jnp.array(S), jnp.array(b))
        np.testing.assert_allclose(x, np.linalg.solve(S, b), rtol=1e-11, atol=1e-15)

    def test_follows_the_dtype(self):
        S, b = jnp.array(definite(4), jnp.float32), jnp.array(right(4), jnp.float32)
        x = semidefinite_solve(S, b)
        assert x.dtype == jnp.float32
        np.testing.assert_allclose(S @ x, b, rtol=1e-5, atol=1e-5)

    @pytest.mark.parametrize("columns", [(), (3,)], ids=["vector", "matrix"])
    @pytest.mark.parametrize("m", [2, *range(4, UNROLLED + 2)])
    def test_derivatives_are_those_of_numpy(self, m, columns):
        """The first along a change of S and b, and the second; S x = b gives S x′ = b′ − S′ x and S x″ = b″ − 2 S′ x′ − S″ x."""
        S, b, dS, db = definite(m), right(m, *columns), definite(m, 2), right(m, *columns, seed=3)
        x = np.linalg.solve(S, b)
        first = np.linalg.solve(S, db - dS @ x)
        second = np.linalg.solve(S, -2 * dS @ first)
        along = lambda fn: lambda h: jax.jvp(fn, (h,), (1.0,))[1]
        moved = lambda h: semidefinite_solve(S + h * dS, b + h * db)
        np.testing.assert_allclose(along(moved)(0.0), first, rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(along(along(moved))(0.0), second, rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(
            jax.grad(lambda h: jnp.sum(moved(h) * x))(0.0), np.sum(first * x), rtol=1e-10, atol=1e-13
        )

    def test_derivatives_eliminate_nothing_anew(self):
        """They take another substitution: the program of a derivative is not several times that of the solution."""
        S, b = definite(UNROLLED), right(UNROLLED)
        size = lambda fn: len(equations(jax.make_jaxpr(fn)(S, b)))
        assert size(lambda S, b: jax.jvp(semidefinite_solve, (S, b), (S, b))) < 2 * size(semidefinite_solve)

    @pytest.mark.parametrize("m", [2, UNROLLED, UNROLLED + 2, LOOPED])
    def test_singular_without_rank_is_nan(self, m):
        x = semidefinite_solve(jnp.array(semidefinite(m, m - 1)), jnp.array(right(m)))
        assert np.isnan(x).any()

    @pytest.mark.parametrize("m", [3, UNROLLED + 2, LOOPED + 1])
    def test_indefinite_is_nan(self, m):
        S = definite(m)
        S[m - 1, m - 1] = -1.0
        assert np.isnan(semidefinite_solve(jnp.array(S), jnp.array(right(m)))).any()

    @pytest.mark.parametrize("columns", [(), (2,)], ids=["vector", "matrix"])
    @pytest.mark.parametrize(("m", "rank"), [(3, 1), (5, 3), (8, 7), (14, 10)])
    def test_minimum_norm(self, m, rank, columns):
        S, b = semidefinite(m, rank), right(m, *columns)
        expected = np.linalg.lstsq(S, b, rcond=1e-10)[0]
        np.testing.assert_allclose(
            semidefinite_solve(jnp.array(S), jnp.array(b), rank), expected, rtol=1e-7, atol=1e-8 * abs(expected).max()
        )

    def test_rank_zero_and_full(self):
        S, b = jnp.array(definite(3)), jnp.array(right(3))
        np.testing.assert_array_equal(semidefinite_solve(0 * S, b, 0), np.zeros(3))
        np.testing.assert_array_equal(semidefinite_solve(S, b, 3), semidefinite_solve(S, b))

    @pytest.mark.parametrize("m", ONE_OF_EACH)
    def test_derivatives(self, m):
        S, b, dS, db, w = definite(m), right(m), definite(m, 5), right(m, seed=6), right(m, seed=7)
        expected = directional(np.linalg.solve, (S, b), (dS, db))
        args = (jnp.array(S), jnp.array(b))
        _, forward = jax.jvp(semidefinite_solve, args, (jnp.array(dS), jnp.array(db)))
        np.testing.assert_allclose(forward, expected, rtol=1e-6, atol=1e-8)
        _, pullback = jax.vjp(semidefinite_solve, *args)
        gS, gb = pullback(jnp.array(w))
        np.testing.assert_allclose(np.sum(gS * dS) + gb @ db, w @ expected, rtol=1e-6)

    def test_derivative_of_the_minimum_norm(self):
        A, dA, b = right(5, 3), right(5, 3, seed=8), right(5)

        def numpy_solve(A):
            return np.linalg.lstsq(A @ A.T, b, rcond=1e-10)[0]

        _, forward = jax.jvp(lambda A: semidefinite_solve(A @ A.T, jnp.array(b), 3), (jnp.array(A),), (jnp.array(dA),))
        np.testing.assert_allclose(forward, directional(numpy_solve, (A,), (dA,)), rtol=1e-5, atol=1e-6)

    @pytest.mark.parametrize("m", ONE_OF_EACH)
    def test_vmap(self, m):
        S, b = np.stack([definite(m, i) for i in range(3)]), right(3, m)
        result = jax.vmap(semidefinite_solve)(jnp.array(S), jnp.array(b))
        np.testing.assert_allclose(result, np.linalg.solve(S, b[..., None])[..., 0], rtol=1e-11)


class TestSolve:
    @pytest.mark.parametrize("n", [1, 2, 5, 32, 33])
    def test_equals_numpy(self, n):
        A, b = right(n, n), right(n, seed=2)
        np.testing.assert_allclose(solve(jnp.array(A), jnp.array(b)), np.linalg.solve(A, b), rtol=1e-9)

    @pytest.mark.parametrize("tiny", [0.0, 1e-20])
    def test_pivots(self, tiny):
        A, b = np.array([[tiny, 2.0, 1.0], [1.0, tiny, 3.0], [4.0, 1.0, tiny]]), np.array([1.0, 2.0, 3.0])
        np.testing.assert_allclose(solve(jnp.array(A), jnp.array(b)), np.linalg.solve(A, b), rtol=1e-14)

    def test_singular_is_not_finite(self):
        assert not np.isfinite(solve(jnp.array([[1.0, 2.0], [2.0, 4.0]]), jnp.array([1.0, 1.0]))).all()

    @pytest.mark.parametrize("n", [4, 33])
    def test_derivatives(self, n):
        A, b, dA, db, w = right(n, n) + n * np.eye(n), right(n, seed=2), right(n, n, seed=3), right(n, seed=4), right(n)
        expected = directional(np.linalg.solve, (A, b), (dA, db))
        args = (jnp.array(A), jnp.array(b))
        np.testing.assert_allclose(
            jax.jvp(solve, args, (jnp.array(dA), jnp.array(db)))[1], expected, rtol=1e-6, atol=1e-9
        )
        gA, gb = jax.vjp(solve, *args)[1](jnp.array(w))
        np.testing.assert_allclose(np.sum(gA * dA) + gb @ db, w @ expected, rtol=1e-6)

    def test_vmap(self):
        A, b = right(5, 4, 4), right(5, 4, seed=2)
        expected = np.linalg.solve(A, b[..., None])[..., 0]
        np.testing.assert_allclose(jax.vmap(solve)(jnp.array(A), jnp.array(b)), expected, rtol=1e-10)


def circle_and_line(x, p):
    """x² + y² = p², y = x: the root is (p, p)/√2."""
    return jnp.stack([x @ x - p**2, x[1] - x[0]])


def cube(x, p):
    return x**3 - p


class TestDeterminantSign:
    @pytest.mark.parametrize("n", ONE_OF_EACH)
    def test_equals_numpy(self, n):
        found = []
        for seed in range(12):
            a = right(n, n, seed=seed)
            a[0, 0] = 0
            found.append(float(determinant_sign(jnp.asarray(a))))
            assert found[-1] == np.linalg.slogdet(a)[0]
        assert set(found) == {1.0, -1.0}

    @pytest.mark.parametrize("n", [1, 4])
    def test_of_a_singular_matrix_and_of_no_numbers(self, n):
        a = np.eye(n)
        a[-1] = 0
        assert determinant_sign(jnp.asarray(a)) == 0
        a[0, -1] = np.nan
        assert jnp.isnan(determinant_sign(jnp.asarray(a)))


class TestNewton:
    def test_converges_to_roundoff(self):
        x, converged = newton(circle_and_line, jnp.array([1.0, 0.5]), jnp.array(2.0))
        assert converged
        np.testing.assert_allclose(x, np.sqrt([2.0, 2.0]), rtol=1e-15)

    def test_from_the_root_itself(self):
        x, converged = newton(cube, jnp.array([2.0]), jnp.array(8.0))
        assert converged
        assert x[0] == 2.0

    @pytest.mark.parametrize(
        ("residual", "x0"),
        [
            (lambda x, p: x**2 + p, 0.7),  # no root
            (lambda x, p: 0 * x + p, 1.0),  # no Jacobian
            (lambda x, p: p + jnp.sqrt(x), 0.5),  # leaves the domain
        ],
    )
    def test_reports_failure(self, residual, x0):
        _, converged = newton(residual, jnp.array([x0]), jnp.array(1.0))
        assert not converged

    def test_reports_too_few_steps(self):
        assert not newton(cube, jnp.array([50.0]), jnp.array(8.0), max_steps=3)[1]

    def test_first_and_second_derivatives(self):
        def root(p):
            return newton(cube, jnp.array([1.5]), p)[0][0]

        p = jnp.array(3.0)
        first, second = 3 ** (-2 / 3) / 3, -2 / 9 * 3 ** (-5 / 3)
        np.testing.assert_allclose(jax.jvp(root, (p,), (jnp.array(1.0),))[1], first, rtol=1e-14)
        np.testing.assert_allclose(jax.grad(root)(p), first, rtol=1e-14)
        for outer in (jax.jacfwd, jax.jacrev):
            for inner in (jax.jacfwd, jax.jacrev):
                np.testing.assert_allclose(outer(inner(root))(p), second, rtol=1e-13)

    def test_derivative_of_several_unknowns_and_a_pytree(self):
        def residual(x, params):
            return circle_and_line(x, params["radius"]) * params["scale"]

        def root(radius, scale):
            return newton(residual, jnp.array([1.0, 0.5]), {"radius": radius, "scale": scale, "name": "circle"})[0]

        by_radius, by_scale = jax.jacrev(root, argnums=(0, 1))(jnp.array(2.0), jnp.array(3.0))
        np.testing.assert_allclose(by_radius, np.sqrt([0.5, 0.5]), rtol=1e-14)
        np.testing.assert_allclose(by_scale, np.zeros(2), atol=1e-14)

    @pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["eager", "jit"])
    @pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
    def test_start_has_no_derivative(self, derivative, transform):
        def root(x0, p):
            return newton(cube, x0[None], p)[0][0]

        by_start, by_p = derivative(transform(root), argnums=(0, 1))(1.5, 3.0)
        assert by_start == 0
        np.testing.assert_allclose(by_p, 3 ** (-2 / 3) / 3, rtol=1e-14)

    def test_vmap(self):
        p = jnp.array([1.0, 8.0, 27.0])
        x, converged = jax.vmap(lambda p: newton(cube, jnp.array([2.5]), p))(p)
        assert converged.all()
        np.testing.assert_allclose(x[:, 0], [1.0, 2.0, 3.0], rtol=1e-14)


def path(n, *, closed=False):
    pattern = np.eye(n, dtype=bool)
    pattern[np.arange(n - 1), np.arange(1, n)] = True
    pattern[0, n - 1] |= closed
    return pattern | pattern.T


def tree(n):
    pattern = np.eye(n, dtype=bool)
    pattern[(np.arange(1, n) - 1) // 2, np.arange(1, n)] = True
    return pattern | pattern.T


def star(n):
    pattern = np.eye(n, dtype=bool)
    pattern[0] = True
    return pattern | pattern.T


def band(n, width):
    return np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= width


PATTERNS = {
    "chain": path(40),
    "closed chain": path(33, closed=True),
    "tree": tree(60),
    "star": star(30),
    "band": band(30, 3),
    "dense": np.ones((9, 9), bool),
    "ring of three": path(3, closed=True),
    "single": np.eye(1, dtype=bool),
    "uncoupled": np.eye(5, dtype=bool),
}


def sparse(pattern, seed=0):
    A = np.where(pattern, np.random.default_rng(seed).normal(size=pattern.shape), 0)
    return A + A.T + 2 * np.diag(np.abs(A + A.T).sum(1) + 0.1)


class TestElimination:
    @pytest.mark.parametrize("name", PATTERNS)
    def test_equals_numpy(self, name):
        order, S = elimination(PATTERNS[name]), sparse(PATTERNS[name])
        b = right(len(S))
        x = order.solve(jnp.diag(jnp.array(S)), jnp.array(S[order.rows, order.columns]), jnp.array(b))
        np.testing.assert_allclose(x, np.linalg.solve(S, b), rtol=1e-12, atol=1e-14)

    @pytest.mark.parametrize(("make", "most"), [(path, 30), (tree, 30), (lambda n: path(n, closed=True), 40)])
    def test_cost_grows_linearly(self, make, most):
        assert elimination(make(256)).cost < most * 256
        assert elimination(make(1024)).cost < 4.5 * elimination(make(256)).cost

    def test_derivatives_in_both_modes(self):
        order, S, b = elimination(tree(20)), sparse(tree(20)), right(20)
        solve = lambda d, c, b: order.solve(d, c, b)
        args = (jnp.diag(jnp.array(S)), jnp.array(S[order.rows, order.columns]), jnp.array(b))
        jax.test_util.check_grads(solve, args, order=1, rtol=1e-6)

    def test_vmap_is_one_at_a_time(self):
        order, S = elimination(path(12)), sparse(path(12))
        bs = right(3, 12)
        d, c = jnp.diag(jnp.array(S)), jnp.array(S[order.rows, order.columns])
        together = jax.vmap(lambda b: order.solve(d, c, b))(jnp.array(bs))
        np.testing.assert_allclose(together, np.linalg.solve(S, bs.T).T, rtol=1e-12)

    def test_singular_is_nan(self):
        S = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
        order = elimination(S != 0)
        x = order.solve(jnp.diag(jnp.array(S)), jnp.array(S[order.rows, order.columns]), jnp.ones(3))
        assert np.isnan(x).any()


class TestRmsNorm:
    def test_value_and_derivative_at_zero(self):
        x = {"a": jnp.array([3.0, 4.0]), "b": jnp.zeros((2, 1))}
        np.testing.assert_allclose(rms_norm(x), 2.5)
        assert (jax.grad(lambda x: rms_norm(x))(jnp.zeros(3)) == 0).all()


def through_lineax(solver, tags=()):
    return lambda a, b: lineax.linear_solve(lineax.MatrixLinearOperator(a, tags), b, solver).value


class TestLineaxSolvers:
    A = definite(4) + np.triu(np.ones((4, 4)), 1)

    def test_general(self):
        b = right(4)
        np.testing.assert_allclose(
            through_lineax(SmallLU())(jnp.array(self.A), jnp.array(b)), np.linalg.solve(self.A, b)
        )

    def test_definite(self):
        S, b = definite(5), right(5)
        solve_with = through_lineax(SmallCholesky(), lineax.positive_semidefinite_tag)
        np.testing.assert_allclose(solve_with(jnp.array(S), jnp.array(b)), np.linalg.solve(S, b))
        with pytest.raises(ValueError, match="positive definite operator"):
            through_lineax(SmallCholesky())(jnp.array(S), jnp.array(b))

    def test_derivatives_and_vmap(self):
        solve_with = through_lineax(SmallLU())
        jax.test_util.check_grads(solve_with, (jnp.array(self.A), jnp.array(right(4))), order=1, rtol=1e-6)
        bs = right(3, 4)
        together = jax.vmap(lambda b: solve_with(jnp.array(self.A), b))(jnp.array(bs))
        np.testing.assert_allclose(together, np.linalg.solve(self.A, bs.T).T)

    def test_pytrees(self):
        operator = lineax.PyTreeLinearOperator(
            {"r": {"x": jnp.eye(2) * 3, "y": jnp.ones((2,))}, "s": {"x": jnp.ones(2), "y": jnp.array(5.0)}},
            {"r": jax.ShapeDtypeStruct((2,), jnp.float64), "s": jax.ShapeDtypeStruct((), jnp.float64)},
        )
        b = {"r": jnp.array([1.0, 2.0]), "s": jnp.array(3.0)}
        found = lineax.linear_solve(operator, b, SmallLU()).value
        expected = lineax.linear_solve(operator, b, lineax.LU()).value
        jax.tree.map(lambda a, c: np.testing.assert_allclose(a, c, rtol=1e-12), found, expected)

    def test_serves_optimistix_without_a_library_call(self):
        residual = lambda y, args: jnp.stack([y[0] ** 2 + y[1] - 3, y[0] - y[1] ** 2 + 1])
        newton_method = optimistix.Newton(1e-12, 1e-12, linear_solver=SmallLU())
        find = lambda y: optimistix.root_find(residual, newton_method, y, throw=False).value
        np.testing.assert_allclose(residual(find(jnp.array([1.0, 1.0])), None), 0, atol=1e-12)
        assert "lu" not in unsupported(jax.make_jaxpr(find)(jnp.array([1.0, 1.0])))


@pytest.mark.parametrize("n", range(1, 9))
def test_small_systems_that_need_their_rows_exchanged(n):
    """With zeros and tiny entries on the diagonal, on both sides of where the elimination is written out."""
    random = np.random.default_rng(n)
    a, b = random.normal(size=(n, n)), random.normal(size=n)
    if n > 1:
        a[np.arange(n), np.arange(n)] = 1e-14 * random.normal(size=n) * (np.arange(n) % 2)
    x = jax.jit(solve)(a, b)
    np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-11)
    direction = random.normal(size=(n, n))
    _, along = jax.jvp(lambda a: solve(a, b), (jnp.asarray(a),), (jnp.asarray(direction),))
    np.testing.assert_allclose(along, -np.linalg.solve(a, direction @ np.asarray(x)), rtol=1e-9)
    assert not np.isfinite(np.asarray(solve(jnp.zeros((n, n)), b))).any()


def partly_known(seed):
    """A regular sparse matrix, and what is known of it: zeros, some units, the rest NaN."""
    random = np.random.default_rng(seed)
    n = int(random.integers(2, 12))
    while True:
        pattern = random.random((n, n)) < 2 / n
        pattern[np.arange(n), random.permutation(n)] = True
        units = pattern & (random.random((n, n)) < 0.5)
        values = np.where(units, random.choice([-1.0, 1.0], (n, n)), pattern * random.normal(size=(n, n)))
        if np.linalg.cond(values) < 1e4:
            return values, np.where(pattern & ~units, np.nan, values)


@pytest.mark.parametrize("seed", range(8))
def test_a_system_reduced_to_its_core(seed):
    a, known = partly_known(seed)
    b = np.random.default_rng(seed + 100).normal(size=len(a))
    found = tearing(known)
    assert len(found.steps) + len(found.rows) == len(a)
    x = np.linalg.solve(a, b)
    np.testing.assert_allclose(found.solve(jnp.asarray(a), jnp.asarray(b)), x, rtol=1e-10, atol=1e-10)
    direction = np.where(np.isnan(known), 1.0, 0.0)
    _, along = jax.jvp(lambda a: found.solve(a, jnp.asarray(b)), (jnp.asarray(a),), (jnp.asarray(direction),))
    np.testing.assert_allclose(along, -np.linalg.solve(a, direction @ x), rtol=1e-9, atol=1e-9)


def test_no_pivot_that_may_be_too_small():
    # The 1 may be tiny beside the unknown entries of its row and column; in the second matrix its row is known.
    assert tearing(np.array([[1.0, np.nan], [np.nan, np.nan]])).steps == ()
    assert len(tearing(np.array([[1.0, -1.0], [np.nan, np.nan]])).steps) == 2
    # Of a triangle, any entry is a pivot; what is left of 1 − 1 is none.
    assert len(tearing(np.array([[np.nan, np.nan], [0.0, np.nan]])).steps) == 2
    assert len(tearing(np.array([[1.0, 1.0], [1.0, 1.0]])).steps) == 1
    # Beyond 32 unknowns LAPACK is faster.
    assert tearing(np.eye(33)).steps == ()


class TestFactors:
    """Of a matrix some of whose rows depend on others, found once for several right-hand sides."""

    @staticmethod
    def unit(m, rank):
        S = semidefinite(m, rank)
        scale = 1 / np.sqrt(np.diag(S))
        return S * scale[:, None] * scale

    @pytest.mark.parametrize(("m", "rank"), [(3, 2), (12, 9), (23, 20), (60, 41)])
    def test_solve_on_as_many_rows_as_are_independent(self, m, rank):
        S, b = self.unit(m, rank), right(m)
        factors = factorised(jnp.array(S), ((m, rank),))
        kept = np.asarray(factors.kept()) == 1
        assert kept.sum() == rank
        x = np.asarray(solve_with(factors, jnp.array(S), jnp.array(b)))
        assert np.all(x[~kept] == 0)
        np.testing.assert_allclose(S[np.ix_(kept, kept)] @ x[kept], b[kept], atol=1e-9 * abs(b).max())

    def test_rows_are_taken_from_the_first_ones_first(self):
        # Rows 0 and 1 are the same, and so are 2 and 3 with 4 beside them: of the first three rows two, of all three.
        vectors = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]])
        factors = factorised(jnp.array(vectors @ vectors.T), ((3, 2), (5, 3)))
        np.testing.assert_array_equal(factors.order, [0, 2, 4])
        np.testing.assert_array_equal(factors.first(2, 3).kept(), [1, 0, 1])

    def test_round_off_does_not_change_which(self):
        S = self.unit(12, 9)
        noise = 1e-13 * np.random.default_rng(0).normal(size=S.shape)
        orders = [factorised(jnp.array(s), ((12, 9),)).order for s in (S, S + noise + noise.T)]
        np.testing.assert_array_equal(*orders)

    @pytest.mark.parametrize("columns", [(), (3,)])
    def test_derivatives_are_those_of_the_solution(self, columns):
        S, b = self.unit(12, 9), right(12, *columns)
        dS, db = self.unit(12, 5), right(12, *columns)[::-1]
        solve = lambda s, b: solve_with(factorised(s, ((12, 9),)), s, b)
        args, dargs = (jnp.array(S), jnp.array(b)), (jnp.array(dS), jnp.array(db))
        _, slope = jax.jvp(solve, args, dargs)
        kept = np.asarray(factorised(args[0], ((12, 9),)).kept()) == 1
        inverse = np.zeros_like(S)
        inverse[np.ix_(kept, kept)] = np.linalg.inv(S[np.ix_(kept, kept)])
        expected = inverse @ (db - dS @ (inverse @ b))
        np.testing.assert_allclose(slope, expected, atol=1e-8 * abs(expected).max())
        weight = np.ones_like(expected)
        of_s, of_b = jax.vjp(solve, *args)[1](jnp.array(weight))
        back = np.sum(of_s * dS) + np.sum(of_b * db)
        np.testing.assert_allclose(back, np.sum(weight * expected), rtol=1e-7)

    def test_what_is_not_definite_gives_nan(self):
        S = semidefinite(12, 9)
        assert np.isnan(solve_with(factorised(jnp.array(S)), jnp.array(S), jnp.array(right(12)))).any()
