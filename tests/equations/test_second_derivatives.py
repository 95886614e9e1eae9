"""Second derivatives of every way in which linear equations are solved here, in all orders of forward and reverse mode."""

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest

from dae_jax.linalg import (
    SmallCholesky,
    SmallLU,
    SparseDefinite,
    elimination,
    factorised,
    newton,
    semidefinite_solve,
    solve,
    solve_with,
    tearing,
)
from dae_jax.linalg.semidefinite import LOOPED, UNROLLED
from dae_jax.linalg.sparse import Sparse
from tests.equations.test_linalg import definite, right, through_lineax


def by_entries(make):
    """Of a full pattern, as solvers of sparse definite systems get it."""

    def found(s, b):
        order = make(np.ones(s.shape, bool))
        return order.solve(jnp.diagonal(s), s[order.rows, order.columns], b)

    return found


def by_sparse_factors(s, b):
    rows, columns = np.nonzero(np.ones(s.shape))
    storage = Sparse(rows, columns, np.arange(len(s)), np.zeros(s.size, bool))
    return storage.solve(storage.factor(s[rows, columns]), b)


SOLVERS = {
    **{f"definite, {m}": (m, semidefinite_solve) for m in (1, 2, 3, UNROLLED, UNROLLED + 1, LOOPED + 1)},
    **{f"general, {n}": (n, solve) for n in (1, 2, 3, 9)},
    "factors": (5, lambda s, b: solve_with(factorised(s), s, b)),
    "elimination along a tree": (4, by_entries(elimination)),
    "elimination along the diagonal": (6, by_entries(SparseDefinite.of)),
    "tearing": (4, lambda s, b: tearing(np.full(s.shape, np.nan)).solve(s, b)),
    "sparse factors": (5, by_sparse_factors),
    "Cholesky for lineax": (4, through_lineax(SmallCholesky(), lineax.positive_semidefinite_tag)),
    "LU for lineax": (4, through_lineax(SmallLU())),
    "Newton": (3, lambda s, b: newton(lambda x, p: p[0] @ x + 0 * x**3 - p[1], jnp.zeros_like(b), (s, b))[0]),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_every_order_of_modes_is_that_of_numpy(name):
    """S(h) x = b(h) with quadratic S and b: S x′ = b′ − S′ x, S x″ = b″ − S″ x − 2 S′ x′."""
    m, solver = SOLVERS[name]
    s, ds, dds = definite(m), definite(m, 2) / 3, definite(m, 4) / 5
    b, db, ddb = (right(m, seed=k) for k in (1, 3, 5))
    x = np.linalg.solve(s, b)
    first = np.linalg.solve(s, db - ds @ x)
    second = np.linalg.solve(s, ddb - dds @ x - 2 * ds @ first)
    weight = right(m, seed=7)
    of = lambda h: weight @ solver(s + h * (ds + h / 2 * dds), b + h * (db + h / 2 * ddb))
    modes = (jax.jacfwd, jax.jacrev)
    derivatives = [jax.jacfwd(of), *(outer(inner(of)) for outer in modes for inner in modes)]
    found = jax.jit(lambda h: jnp.stack([derivative(h) for derivative in derivatives]))(0.0)
    np.testing.assert_allclose(found, [weight @ first, *4 * [weight @ second]], rtol=1e-8)
