"""Derivatives with respect to the ends of the interval and to saved times, at the ends of steps too."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


# ẋ = −x z with z = x, so that x = x₀/(1 + x₀ (t − t₀)).
SYSTEM = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x * z, lambda t, x, z, a: z - x)
START = 2.0
SOLVERS = [dae_jax.RadauIIA5(), dae_jax.Radau(), dae_jax.BDF(), dae_jax.OrthogonalProjection(dae_jax.DOP853())]


def exact(t0, times):
    return START / (1 + START * (times - t0))


def x_at(solver, t0, t1, times, dt0=None, event=None):
    y0 = jnp.array([START]), jnp.array([START])
    controller = diffrax.ConstantStepSize() if dt0 else diffrax.PIDController(rtol=1e-9, atol=1e-9)
    saveat = diffrax.SaveAt(ts=times)
    sol = dae_jax.daesolve(SYSTEM, solver, t0, t1, dt0, y0, saveat=saveat, stepsize_controller=controller, event=event)
    return sol.ys[0][:, 0]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("dt0", [None, 1 / 64])
@pytest.mark.parametrize("end", [1.0, -0.25])
def test_at_the_ends_of_steps(solver, dt0, end):
    """At t₀, t₁ and, for fixed steps, where a step ends."""
    if dt0 and not isinstance(solver, dae_jax.RadauIIA5 | dae_jax.OrthogonalProjection):
        pytest.skip("the others choose their steps")
    times = jnp.array([0.0, end / 2, end])
    # A polynomial of a fixed step has its slopes to its own order.
    step, atol = (None, 2e-6) if dt0 is None else (dt0 * np.sign(end), 1e-4)
    by_t0, by_t1, by_times = jax.jacfwd(lambda a, b, ts: x_at(solver, a, b, ts, step), (0, 1, 2))(0.0, end, times)
    rate = -(exact(0, np.array(times)) ** 2)
    np.testing.assert_allclose(by_times, np.diag(rate), atol=atol)
    np.testing.assert_allclose(by_t0, -rate, atol=atol)
    np.testing.assert_allclose(by_t1, 0, atol=atol)


@pytest.mark.parametrize("solver", SOLVERS[:1] + SOLVERS[-1:], ids=lambda s: type(s).__name__)
def test_reverse_mode_agrees(solver):
    times, weights = jnp.array([0.0, 0.5, 1.0]), jnp.array([1.0, -2.0, 3.0])
    weighted = lambda a, b, ts: weights @ x_at(solver, a, b, ts)
    by_t0, by_t1, by_times = jax.grad(weighted, (0, 1, 2))(0.0, 1.0, times)
    rate = -(exact(0, np.array(times)) ** 2)
    np.testing.assert_allclose(by_times, np.array(weights) * rate, atol=2e-6)
    np.testing.assert_allclose([by_t0, by_t1], [-weights @ rate, 0], atol=2e-6)


@pytest.mark.parametrize("solver", SOLVERS[:1] + SOLVERS[-1:], ids=lambda s: type(s).__name__)
def test_dense_output_has_its_rate_at_the_ends(solver):
    y0 = jnp.array([START]), jnp.array([START])
    controller = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    saveat = diffrax.SaveAt(dense=True)
    sol = dae_jax.daesolve(SYSTEM, solver, 0.0, 1.0, None, y0, saveat=saveat, stepsize_controller=controller)
    for t in (0.0, 0.3, 1.0):
        rate = jax.jacfwd(lambda t: sol.evaluate(t)[0])(t)
        np.testing.assert_allclose(rate, -(exact(0, t) ** 2), rtol=2e-4)


@pytest.mark.parametrize("solver", SOLVERS[:1] + SOLVERS[-1:], ids=lambda s: type(s).__name__)
def test_with_a_reset(solver):
    """At t₀, before and after x is doubled at ½, and at t₁."""
    reset = dae_jax.Reset(lambda t, y, a, **_: y[0][0] - 0.5, lambda t, y, a: (jax.tree.map(lambda u: 2 * u, y), a))
    times = jnp.array([0.0, 0.5, 2.0, 2.25])
    by_t0, by_times = jax.jacfwd(lambda a, ts: x_at(solver, a, 2.25, ts, event=reset), (0, 1))(0.0, times)
    # x = ½ at 3/2.
    rate = -np.array([exact(0, t) ** 2 if t < 1.5 else 1 / (1 + t - 1.5) ** 2 for t in times])
    np.testing.assert_allclose(by_times, np.diag(rate), atol=2e-6)
    np.testing.assert_allclose(by_t0, -rate, atol=2e-6)


WITH_FIELDS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
    "tangent": (dae_jax.TangentSpace(diffrax.Tsit5()), None),
    "dummy": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
}


@pytest.mark.parametrize("end", [1.0, -0.25])
@pytest.mark.parametrize("method", WITH_FIELDS)
def test_dense_output_moves_as_the_equations_say(method, end):
    """Between steps ẋ = −x², ẍ = 2x³ and ∂ẋ/∂x₀ = −2x ∂x/∂x₀, as exact as x: slopes of polynomials are 1e-7 off, and more."""
    solver, formulation = WITH_FIELDS[method]
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-10)

    def x_at_time(start, t):
        y0, saveat = (start[None], start[None]), diffrax.SaveAt(dense=True)
        sol = dae_jax.daesolve(
            SYSTEM, solver, 0.0, end, None, y0, saveat=saveat, stepsize_controller=controller, formulation=formulation
        )
        return sol.evaluate(t)[0][0]

    start, times = jnp.asarray(START), end * jnp.array([0.0, 0.11, 0.52, 0.97, 1.0])
    rate = jax.jit(jax.vmap(jax.grad(x_at_time, 1), (None, 0)))
    x, by_start = exact(0, times), 1 / (1 + START * times) ** 2
    np.testing.assert_allclose(rate(start, times), -(x**2), rtol=2e-8)
    second = jax.vmap(jax.jacfwd(jax.jacfwd(x_at_time, 1), 1), (None, 0))(start, times)
    np.testing.assert_allclose(second, 2 * x**3, rtol=2e-8)
    for derivative in (jax.jacfwd, jax.jacrev):
        mixed = jax.vmap(derivative(jax.jacfwd(x_at_time, 1)), (None, 0))(start, times)
        np.testing.assert_allclose(mixed, -2 * x * by_start, rtol=1e-7)
