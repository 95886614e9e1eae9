"""What follows from a derivative in a limit only, where the structure does not say so: it is as exact as what does so by structure."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


END = 3.0
SOLVERS = {
    "RadauIIA5": dae_jax.RadauIIA5(), "RadauIIA9": dae_jax.RadauIIA9(), "RadauIIA13": dae_jax.RadauIIA13(),
    "Radau": dae_jax.Radau(),
}  # fmt: skip
CHARGED = dae_jax.ImplicitDAE(
    lambda t, y, yd, args: jnp.stack([yd[0] - y[1], args[0] * y[1] - args[1] * jnp.sin(t) + y[0]])
)
MASS_ON_SPRING = dae_jax.ImplicitDAE(
    lambda t, y, yd, m: jnp.stack([yd[0] - y[1], m[0] * yd[1] + m[1] * y[1] + 2 * y[0] - jnp.sin(t)])
)


def current(r, t):
    """Through a resistor r onto a capacitor from the source sin t, after a long time."""
    return (np.cos(t) + r * np.sin(t)) / (1 + r * r)


def solve(system, solver, y0, args, tol):
    steps = diffrax.PIDController(rtol=tol, atol=tol)
    return dae_jax.daesolve(system, solver, 0.0, END, None, jnp.asarray(y0), args, stepsize_controller=steps)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_current_through_a_small_resistor(name):
    for r in (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 0.0):
        for tol in (1e-5, 1e-8):
            y0 = [(0 - r) / (1 + r * r), current(r, 0.0)]
            sol = solve(CHARGED, SOLVERS[name], y0, jnp.array([r, 1.0]), tol)
            assert abs(float(sol.ys[-1, 1]) - current(r, END)) < 100 * tol, (r, tol)


@pytest.mark.parametrize("name", SOLVERS)
def test_the_velocity_of_a_small_mass(name):
    """m ẍ + c ẋ + 2 x = sin t, from where m = c = 0 starts; a differential variable by structure."""
    for m, c in ((1e-12, 0.0), (1e-14, 1e-7), (0.0, 0.0)):
        for tol in (1e-5, 1e-8):
            sol = solve(MASS_ON_SPRING, SOLVERS[name], [0.0, 0.5], jnp.array([m, c]), tol)
            assert abs(float(sol.ys[-1, 1]) - np.cos(END) / 2) < 100 * tol + m + c, (m, c, tol)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives(derivative):
    end = lambda u: solve(CHARGED, SOLVERS["RadauIIA5"], jnp.stack([0 * u, u]), jnp.stack([0 * u, u]), 1e-8).ys[-1, 1]
    np.testing.assert_allclose(derivative(end)(1.0), np.cos(END), rtol=1e-6)
