"""`consistent_state` gives the nearest state, however fast the dynamics are."""

import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.equations.nearest_step import step_to


@pytest.mark.parametrize("copies", [1, 100], ids=["dense", "sparse"])
@pytest.mark.parametrize("speed", [1.0, 1e4, 1e9])
def test_fast_dynamics_do_not_draw_on_the_values(speed, copies):
    """A supply behind a resistor: g ties x₀ and w alone, x₁ is of the dynamics only."""
    system = dae_jax.SemiExplicitDAE(
        lambda t, x, w, args: speed * jnp.stack([w - x[1], x[0] - x[1] / 5]),
        lambda t, x, w, args: (24 - w) / 0.01 - w / 1e6 - x[0],
    )
    (x, idle), w = dae_jax.consistent_state(system, 0.0, (jnp.zeros((2, copies)), jnp.zeros(copies)))
    slope = 100 + 1e-6
    np.testing.assert_allclose(x, 2400 / (1 + slope**2), rtol=1e-9)
    np.testing.assert_allclose(w, 2400 * slope / (1 + slope**2), rtol=1e-12)
    np.testing.assert_allclose(idle, 0, atol=1e-9)


@pytest.mark.parametrize("fixed", [False, True])
def test_a_step_is_the_shortest_in_the_values(fixed):
    """Against elimination of the derivatives by their null space, in numpy."""
    rng = np.random.default_rng(0)
    of_values, of_rates, off = rng.normal(size=(7, 6)), rng.normal(size=(7, 4)), rng.normal(size=7)
    weights = np.ones(6)
    weights[2] = 0.0 if fixed else 1.0
    # Rates of very different sizes, and one that stands in no equation.
    of_rates = of_rates * [1e6, 1.0, 1e-3, 0.0]
    left = np.linalg.svd(of_rates[:, :3])[0][:, 3:].T
    shortest = -np.linalg.lstsq(left @ of_values * weights, left @ off, rcond=None)[0] * weights
    is_rate = np.arange(10) >= 6
    x = np.asarray(
        step_to(
            jnp.asarray(np.concatenate([of_values, of_rates], 1)),
            jnp.asarray(off),
            jnp.asarray(np.concatenate([weights, np.ones(4)])),
            is_rate,
        )
    )
    np.testing.assert_allclose(x[:6], shortest, atol=1e-10)
    np.testing.assert_allclose(of_values @ x[:6] + of_rates @ x[6:], -off, atol=1e-9)
    assert x[9] == 0
