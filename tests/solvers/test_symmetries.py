"""Symmetries that a step of every method has, whatever its error: no clock and no direction of time is in the equations."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from tests.methods import METHODS, Method


# A spherical pendulum with a spring in a corner: no plane of it is like another.
SYSTEM = dae_jax.ConstrainedSystem(
    lambda t, q, v, args: jnp.array([0.3, -0.2, -9.81]) - 2 * (q - jnp.array([1.0, 0.5, 0.2])),
    lambda t, q, args: (jnp.sum(q**2) - 1) / 2,
    jnp.array([1.0, 1.0, 2.0]),
)
Q, V = np.array([0.6, 0.0, -0.8]), np.array([0.8, -0.5, 0.6])
OTHERS = [
    Method("bdf", dae_jax.BDF(), 5, formulation=dae_jax.GGL(), adaptive=True),
    Method("dummy-derivatives", diffrax.Tsit5(), 5, True, dae_jax.DummyDerivatives(), adaptive=True),
]
CASES = [m for m in METHODS if not m.twin and m.name != "state-space"] + OTHERS


@pytest.mark.parametrize("method", CASES, ids=lambda m: m.name)
def test_time_may_be_shifted_and_reversed(method):
    """Backwards from (q, v) is forwards from (q, −v), mirrored; the time of the start makes no difference."""
    control = diffrax.PIDController(rtol=1e-6, atol=1e-6) if method.adaptive else diffrax.ConstantStepSize()

    @jax.jit
    def end(t0, t1, h, v):
        return dae_jax.daesolve(
            SYSTEM, method.solver, t0, t1, h, (Q, v), formulation=method.formulation, stepsize_controller=control
        ).ys  # fmt: skip

    q, v = end(0.0, 0.5, 0.0625, V)
    assert np.abs(q[-1] - Q).max() > 0.05
    # Of times that are added and subtracted without rounding.
    q_later, v_later = end(64.0, 64.5, 0.0625, V)
    q_back, v_back = end(0.0, -0.5, -0.0625, -V)
    for found, expected in ((q_later, q), (v_later, v), (q_back, q), (v_back, -v)):
        np.testing.assert_allclose(found, expected, atol=1e-9)
