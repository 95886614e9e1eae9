"""Solves of a batch that failed and that a loss leaves out have no part in its derivative."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


# Decay with the rate own · shared.
DECAY = dae_jax.ImplicitDAE(lambda t, y, yd, k: jnp.stack([yd[0] + k[0] * k[1] * y[0], y[1] - y[0] ** 2]))
OWN = jnp.array([1.0, jnp.nan, 2.0])


def loss(shared, own, solver, **options):
    def one(own):
        sol = dae_jax.daesolve(DECAY, solver, 0.0, 1.0, None, jnp.ones(2), (own, shared), throw=False, **options)
        return jnp.where(sol.result == dae_jax.RESULTS.successful, sol.ys[-1, 0], 0.0)

    return jnp.sum(jax.vmap(one)(own))


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.BDF()], ids=["tsit5", "bdf"])
def test_a_masked_lane_leaves_shared_parameters_their_gradient(solver):
    """In forward mode the mask itself leaves it out; in reverse mode 0 times a Jacobian that is not a number would be none."""
    by_shared, by_own = jax.jit(jax.grad(lambda *x: loss(*x, solver), (0, 1)))(1.0, OWN)
    exact = np.exp([-1.0, -2.0])
    np.testing.assert_allclose(by_shared, -exact @ [1, 2], rtol=1e-6)
    np.testing.assert_allclose(by_own, [-exact[0], 0, -exact[1]], rtol=1e-6)


def test_forward_and_second_derivatives_of_the_others():
    solver, exact = diffrax.Tsit5(), np.exp([-1.0, -2.0])
    forward = jax.jvp(lambda x: loss(x, OWN, solver, adjoint=diffrax.ForwardMode()), (1.0,), (1.0,))[1]
    np.testing.assert_allclose(forward, -exact @ [1, 2], rtol=1e-6)
    second = jax.jit(jax.jacfwd(jax.grad(lambda x: loss(x, OWN, solver))))(1.0)
    np.testing.assert_allclose(second, exact @ [1, 4], rtol=1e-6)


def test_a_lane_that_counts_has_no_derivative_still():
    lost = lambda shared: dae_jax.daesolve(
        DECAY, diffrax.Tsit5(), 0.0, 1.0, None, jnp.ones(2), (jnp.nan, shared), throw=False
    ).ys[-1, 0]
    assert np.isnan(jax.grad(lost)(1.0))
