"""Derivatives with respect to times, of events, of what is saved, of jumps that are announced, which are those of the flow; and the two
sides of a jump.
"""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax


TOLERANCE = 1e-9
CONTROL = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE)
# ẋ = −x z with z = x, so that x = x₀/(1 + x₀ (t − t₀)).
SYSTEM = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x * z, lambda t, x, z, a: z - x)
START = jnp.array([2.0]), jnp.array([2.0])


@pytest.mark.parametrize("formulation", [None, dae_jax.DummyDerivatives()], ids=["as written", "dummy derivatives"])
def test_of_a_reset_in_the_first_steps_after_it(formulation):
    """x is doubled at T: the first steps of `BDF` are short, and their ends say little of how it moves with their sizes."""
    doubled = dae_jax.Reset(lambda t, y, a, **_: t - a, lambda t, y, a: (jax.tree.map(lambda u: 2 * u, y), a))
    after = np.array([1e-6, 1e-4, 1e-2])

    def exact(at, times):
        x = 4 / (1 + 2 * at)
        return x / (1 + x * (times - at))

    def found(at):
        sol = dae_jax.daesolve(
            SYSTEM, dae_jax.BDF(), 0.0, 0.6, None, START, at, event=doubled, saveat=diffrax.SaveAt(ts=0.5 + after),
            stepsize_controller=CONTROL, formulation=formulation,
        )  # fmt: skip
        return sol.ys[0][:, 0]

    of_exact = jax.jacfwd(exact)(0.5, 0.5 + after)
    np.testing.assert_allclose(jax.jacfwd(found)(0.5), of_exact, rtol=200 * TOLERANCE)


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.RadauIIA5()], ids=lambda s: type(s).__name__)
def test_second_derivatives_of_the_time_of_an_event(solver):
    """x = c at 1/c − 1/x₀ exactly, where polynomials between steps have bends that are 1e-6 off."""

    def found(p):
        event = diffrax.Event(lambda t, y, c, **_: y[0][0] - c, optimistix.Newton(1e-11, 1e-11))
        start = p[:1], p[:1]
        sol = dae_jax.daesolve(SYSTEM, solver, 0.0, 3.0, None, start, p[1], event=event, stepsize_controller=CONTROL)
        return sol.ts[-1]

    exact = lambda p: 1 / p[1] - 1 / p[0]
    p = jnp.array([2.0, 0.7])
    np.testing.assert_allclose(jax.hessian(found)(p), jax.hessian(exact)(p), atol=200 * TOLERANCE)


METHODS = {
    "explicit": (dae_jax.DOP853(), None),
    "dummy": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    "radau": (dae_jax.RadauIIA5(), None),
    "bdf": (dae_jax.BDF(), None),
}
MODES = {"forward": jax.jacfwd, "reverse": jax.jacrev}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("method", ["tsit5", "radau"])
def test_by_the_times_that_are_saved(method, mode):
    """Between steps slopes of polynomials are 3,415 and 309 tolerances off."""
    solver = {"tsit5": diffrax.Tsit5(), "radau": dae_jax.RadauIIA5()}[method]
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -x * z * jnp.cos(t), lambda t, x, z, a: z - x)

    def found(t0, ts):
        sol = dae_jax.daesolve(
            system, solver, t0, 2.0, None, START, saveat=diffrax.SaveAt(ts=ts), stepsize_controller=CONTROL
        )
        return sol.ys[0][:, 0], sol.ys[1][:, 0]

    def exact(t0, ts):
        x = 1 / (1 / 2 + jnp.sin(ts) - jnp.sin(t0))
        return x, x

    at = 0.0, jnp.linspace(0.01, 1.99, 37)
    for of_found, of_exact in zip(
        *(jax.tree.leaves(MODES[mode](fn, (0, 1))(*at)) for fn in (found, exact)), strict=True
    ):
        np.testing.assert_allclose(of_found, of_exact, atol=200 * TOLERANCE)


@pytest.mark.parametrize("modes", [*itertools.product(MODES, MODES)], ids="-".join)
def test_second_derivatives_by_times_and_by_others(modes):
    """x = x₀/(1 + x₀ (t − t₀)); by what stands still first, too."""
    first, then = (MODES[mode] for mode in modes)

    def found(x0, t0, t1):
        start = x0[None], x0[None]
        return dae_jax.daesolve(
            SYSTEM, dae_jax.DOP853(), t0, t1, None, start, stepsize_controller=CONTROL
        ).ys[0][-1, 0]  # fmt: skip

    exact = lambda x0, t0, t1: x0 / (1 + x0 * (t1 - t0))
    at = jnp.asarray(2.0), 0.0, 1.5
    for by, also in [(0, (1, 2)), ((1, 2), 0)]:
        of_found, of_exact = (jax.tree.leaves(then(first(fn, by), also)(*at)) for fn in (found, exact))
        np.testing.assert_allclose(of_found, of_exact, atol=200 * TOLERANCE)


def test_a_third_derivative_by_a_time_at_last():
    end = lambda x0, t1: dae_jax.daesolve(
        SYSTEM, dae_jax.DOP853(), 0.0, t1, None, (x0[None], x0[None]), stepsize_controller=CONTROL
    ).ys[0][-1, 0]  # fmt: skip
    exact = lambda x0, t1: x0 / (1 + x0 * t1)
    third = lambda fn: jax.jacfwd(jax.jacfwd(jax.jacrev(fn)), 1)(jnp.asarray(2.0), 1.5)
    np.testing.assert_allclose(third(end), third(exact), atol=200 * TOLERANCE)


@pytest.mark.parametrize("end", [2.0, -2.0])
@pytest.mark.parametrize("method", METHODS)
def test_both_sides_of_a_jump_that_is_announced(method, end):
    """ẋ = z, where z = u(t) jumps at half of the way."""
    solver, formulation = METHODS[method]
    at = end / 2
    u = lambda t: jnp.where(t < at, jnp.sin(t), 2 + t)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z - u(t))
    control = diffrax.ClipStepSizeController(diffrax.PIDController(rtol=1e-8, atol=1e-8), jump_ts=jnp.array([at]))
    sol = dae_jax.daesolve(
        system, solver, 0.0, end, None, (jnp.zeros(()), u(0.0)), formulation=formulation, stepsize_controller=control,
        saveat=diffrax.SaveAt(dense=True),
    )  # fmt: skip
    before, after = (np.sin(at), 2 + at) if end > 0 else (2 + at, np.sin(at))
    np.testing.assert_allclose(sol.evaluate(at, left=True)[1], before, rtol=1e-12)
    np.testing.assert_allclose(sol.evaluate(at, left=False)[1], after, rtol=1e-12)


@pytest.mark.parametrize("adjoint", ["forward", "reverse"])
def test_of_an_algebraic_variable_between_steps(adjoint):
    """The steps of the derivative were found as though only their ends were asked for: it was 3e6 tolerances off."""
    tolerance, times = 1e-6, jnp.array([0.3, 1.1])
    # x₁ = sin at, of index 4.
    system = dae_jax.ImplicitDAE(
        lambda t, y, yd, a: jnp.stack([yd[0] - y[1], yd[1] - y[2], yd[2] - y[3], y[0] - jnp.sin(a * t)])
    )

    def found(a):
        start = jnp.stack([0 * a, a, 0 * a, -(a**3)])
        sol = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 2.0, None, start, a, saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        )  # fmt: skip
        return sol.ys[:, 3]

    slope = jax.jacfwd(lambda a: -(a**3) * jnp.cos(a * times))(1.7)
    sides = jnp.array([1.0, -2.0])
    error = (
        jax.jvp(found, (1.7,), (1.0,))[1] - slope
        if adjoint == "forward"
        else jax.grad(lambda a: sides @ found(a))(1.7) - sides @ slope
    )
    np.testing.assert_allclose(error, 0, atol=200 * tolerance)
