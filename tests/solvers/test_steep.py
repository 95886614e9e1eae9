"""Equations that are steep where a step starts and flat where it ends: a correction by the steep slope is small however far
the solution is, and must not pass for convergence. Whatever is successful is right.
"""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.linalg import newton
from dae_jax.structure import is_linear


END = 2.0
# What is left of sin t above 1/2, over time.
ABOVE = np.cos(np.pi / 6) - np.cos(END) - 0.5 * (END - np.pi / 6)


def saturation(u, smooth):
    """Between −1/2 and 1/2, with slope 1 at 0."""
    return jnp.where(smooth, 0.5 * jnp.tanh(2 * u), jnp.clip(u, -0.5, 0.5))


def in_state(t, x, z, args):
    """0 = z − s(k x), where x' = sin t − z: x stays within 1/k of 0 as long as sin t < 1/2."""
    k, smooth = args
    return z - saturation(k * x, smooth)


def in_unknown(t, x, z, args):
    """0 = z + s(k z) − sin t, where x' = z: z stays within 1/k of 0 as long as sin t < 1/2."""
    k, smooth = args
    return z + saturation(k * z, smooth) - jnp.sin(t)


SYSTEMS = {
    "in state": (dae_jax.SemiExplicitDAE(lambda t, x, z, args: jnp.sin(t) - z, in_state), 0.5),
    "in unknown": (dae_jax.SemiExplicitDAE(lambda t, x, z, args: z, in_unknown), np.sin(END) - 0.5),
}
METHODS = {
    "radau": (dae_jax.RadauIIA5(), None),
    "radau of order 13": (dae_jax.RadauIIA13(), None),
    "bdf": (dae_jax.BDF(), None),
    "dummy derivatives, explicit": (diffrax.Tsit5(), dae_jax.DummyDerivatives()),
    "dummy derivatives, radau": (dae_jax.RadauIIA5(), dae_jax.DummyDerivatives()),
    "dummy derivatives, bdf": (dae_jax.BDF(), dae_jax.DummyDerivatives()),
}
AS_WRITTEN = ["radau", "radau of order 13", "bdf"]


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("method", METHODS)
def test_what_is_successful_is_right(method, system):
    solver, formulation = METHODS[method]
    equations, end = SYSTEMS[system]
    zero = (jnp.zeros(1), jnp.zeros(1))
    for tolerance, k, smooth in itertools.product((1e-5, 1e-8), (1e3, 1e5, 1e7, 1e9, 1e12), (False, True)):
        sol = dae_jax.daesolve(
            equations, solver, 0.0, END, None, zero, (jnp.asarray(k), jnp.asarray(smooth)), formulation=formulation,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), throw=False, max_steps=4096,
        )  # fmt: skip
        case = f"tolerance {tolerance}, k = {k}, {'tanh' if smooth else 'clip'}"
        if method in AS_WRITTEN:
            assert sol.result == dae_jax.RESULTS.successful, case
        if sol.result == dae_jax.RESULTS.successful:
            x, z = sol.final
            np.testing.assert_allclose(x, ABOVE, atol=50 * tolerance + 3 / k, err_msg=case)
            np.testing.assert_allclose(z, end, atol=50 * tolerance + 3 / k, err_msg=case)


@pytest.mark.parametrize("steepness", [1e3, 1e9, 1e12])
def test_newton_goes_on_after_a_small_first_correction(steepness):
    residual = lambda z, w: z - w + jnp.clip(steepness * z, -0.5, 0.5)
    z, found = newton(residual, jnp.zeros(1), jnp.asarray([0.9]))
    assert found
    np.testing.assert_allclose(z, 0.4, atol=1e-14)


@pytest.mark.parametrize(
    ("of", "linear"),
    [
        (lambda a, x: a * x + jnp.sin(a), True),
        (lambda a, x: jnp.where(a > 0, x, 2 * x), True),
        (lambda a, x: jnp.cumsum(x) * jnp.floor(a), True),
        (lambda a, x: x * x, False),
        (lambda a, x: jnp.abs(x), False),
        (lambda a, x: jnp.clip(x, -1, 1), False),
        (lambda a, x: jnp.maximum(a, x), False),
        (lambda a, x: jnp.where(x > 0, x, 2 * x), False),
        (lambda a, x: x + jnp.sign(x), False),
        (lambda a, x: x + jnp.floor(x), False),
        (lambda a, x: x + jax.lax.stop_gradient(x), False),
        (lambda a, x: x + x.astype(int), False),
        (lambda a, x: jnp.sort(x), False),
        (lambda a, x: a[jnp.argsort(x)], False),
        (lambda a, x: jax.lax.cond(x[0] > 0, lambda: a, lambda: 2 * a), False),
    ],
)
def test_kinks_and_jumps_are_not_linear(of, linear):
    assert is_linear(of, jnp.ones(3), jnp.ones(3), argument=1) == linear


def test_an_algebraic_equation_with_a_kink_is_no_linear_one():
    """0 = z + |z|/2 − 1.5 sin t: z is sin t above 0 and 3 sin t below."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z + jnp.abs(z) / 2 - 1.5 * jnp.sin(t))
    sol = dae_jax.daesolve(
        system, diffrax.Tsit5(), 0.1, 6.0, None, (jnp.zeros(1), jnp.full(1, np.sin(0.1))),
        formulation=dae_jax.DummyDerivatives(), stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )  # fmt: skip
    exact = np.cos(0.1) + 1 + 3 * (-1 - np.cos(6.0))
    x, z = sol.final
    np.testing.assert_allclose(z, 3 * np.sin(6.0), atol=1e-7)
    np.testing.assert_allclose(x, exact, atol=1e-7)
