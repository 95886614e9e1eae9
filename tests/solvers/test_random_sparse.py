"""Linear systems of index 1 with random patterns, in random units, beside the matrix exponential."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from scipy.linalg import expm

import dae_jax


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize(("n", "decades"), [(60, 0), (90, 6)])
def test_beside_the_exponential(n, decades, solver):
    """ẋ = A x + B z, 0 = C x + G z, with rows and unknowns in units of 10^±`decades`."""
    rng, m = np.random.default_rng(n), n // 3
    d = n - m
    random = lambda k, columns: scipy.sparse.random_array(
        (k, columns), density=4 / n, rng=rng, data_sampler=lambda size: rng.normal(size=size)
    ).toarray()
    a, b, c = random(d, d) - 2 * np.eye(d), random(d, m), random(m, d)
    g = np.eye(m)[rng.permutation(m)] * rng.uniform(1, 3, (m, 1)) + 0.3 * random(m, m)
    units, rows = 10.0 ** rng.uniform(-decades, decades, (2, n))
    matrix = np.block([[a, b], [-c, -g]])
    i, j = matrix.nonzero()

    def residual(t, y, yd, args):
        left = jax.ops.segment_sum(matrix[i, j] * (units * y)[j], i, n)
        return rows * (jnp.concatenate([(units * yd)[:d], jnp.zeros(m)]) - left)

    x = rng.normal(size=d)
    given_x = lambda x: np.concatenate([x, -np.linalg.solve(g, c @ x)])
    system, y0 = dae_jax.ImplicitDAE(residual), jnp.asarray(given_x(x) / units)
    assert dae_jax.explain(system, solver, 0.0, y0).linear_solver.startswith("sparse")
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-8 / units.max())
    sol = dae_jax.daesolve(system, solver, 0.0, 1.0, None, y0, stepsize_controller=controller)
    truth = given_x(expm(a - b @ np.linalg.solve(g, c)) @ x)
    np.testing.assert_allclose(sol.ys[-1] * units, truth, atol=1e-6 * np.abs(truth).max())
