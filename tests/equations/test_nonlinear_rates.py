"""Equations that are nonlinear in ẏ: ẏ at the start is searched for, given, or refused where there are several."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dae_jax


def exact(t):
    return np.array([np.sin(t), t + np.sin(t) / 2])


def squared(t, y, yd, args):
    """(sin² ẏ₁ + cos² y₂) ẏ₂² is given, for ẏ₂ = 1 + cos t/2."""
    second = t + jnp.sin(t) / 2
    right = (jnp.sin(jnp.cos(t)) ** 2 + jnp.cos(second) ** 2) * (1 + jnp.cos(t) / 2) ** 2
    return [yd[0] - jnp.cos(t) + y[1] - second, (jnp.sin(yd[0]) ** 2 + jnp.cos(y[1]) ** 2) * yd[1] ** 2 - right]


def cubed(t, y, yd, args):
    """ẏ³ + ẏ = 2 y, which has one real solution, flat in ẏ at a point between it and 0."""
    return yd**3 - 1.5 * yd**2 + yd - y


SOLVERS = {
    "radau": dae_jax.RadauIIA5(),
    "bdf": dae_jax.BDF(),
    "projection": dae_jax.OrthogonalProjection(dae_jax.DOP853()),
}


def solved(residual, y0, solver, **options):
    return dae_jax.daesolve(dae_jax.ImplicitDAE(residual), solver, 0.0, 1.0, None, y0, **options)


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_rates_at_the_start_are_given(solver):
    sol = solved(squared, jnp.zeros(2), SOLVERS[solver], yd0=jnp.array([1.0, 1.4]))
    np.testing.assert_allclose(sol.ys[-1], exact(1.0), atol=1e-6)
    back = solved(squared, jnp.zeros(2), SOLVERS[solver], yd0=jnp.array([1.0, -1.4]), throw=False)
    assert back.ys[-1][1] < exact(1.0)[1] - 0.1 or back.result != dae_jax.RESULTS.successful


def test_several_rates_are_refused_and_named():
    with pytest.raises(ValueError, match="several ẏ satisfy them at the start: say which by `yd0`"):
        solved(squared, jnp.zeros(2), dae_jax.RadauIIA5())
    result = jax.jit(lambda y0: solved(squared, y0, dae_jax.RadauIIA5(), throw=False).result)(jnp.zeros(2))
    assert result == dae_jax.RESULTS.ambiguous_start


@pytest.mark.parametrize("solver", ["radau", "projection"])
def test_the_only_rates_are_found(solver):
    sol = solved(cubed, jnp.array([2.0]), SOLVERS[solver])
    # dy/dt = p with y = p³ − 1.5 p² + p: dt = (3p − 3 + 1/p) dp.
    time = lambda p: 1.5 * p**2 - 3 * p + np.log(p)
    start, end = (np.roots([1, -1.5, 1, -float(y)]) for y in (2.0, sol.ys[-1][0]))
    start, end = (float(roots[np.abs(roots.imag) < 1e-9].real[0]) for roots in (start, end))
    np.testing.assert_allclose(time(end) - time(start), 1.0, atol=1e-6)


def test_rates_are_for_implicit_systems_and_have_the_structure_of_the_state():
    with pytest.raises(ValueError, match=r"`yd0` must hold numbers in the structure of the state"):
        solved(squared, jnp.zeros(2), dae_jax.RadauIIA5(), yd0=(1.0, 1.4))
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: z, lambda t, x, z, args: z - x)
    with pytest.raises(ValueError, match=r"`yd0` is for an ImplicitDAE"):
        dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1.0, None, (jnp.ones(1), jnp.ones(1)), yd0=jnp.ones(2))


def test_the_nearest_state_with_given_rates_near_by():
    system = dae_jax.ImplicitDAE(squared)
    y0 = dae_jax.consistent_state(system, 0.0, jnp.zeros(2), yd0=jnp.array([1.0, 1.4]))
    np.testing.assert_allclose(y0, 0, atol=1e-9)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6])
def test_the_search_knows_no_unit_of_time(unit):
    """T ẏ = 3 or −1; and ln y − 1 alone, beside which exp T ẏ overflows or vanishes."""
    solve = lambda residual: dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual), dae_jax.RadauIIA5(), 0.0, 0.5 * unit, None, jnp.ones(1)
    )
    with pytest.raises(ValueError, match="several ẏ satisfy them at the start"):
        solve(lambda t, y, yd, args: (unit * yd - 3) * (unit * yd + 1))
    sol = solve(lambda t, y, yd, args: jnp.exp(unit * yd) - y / jnp.e)
    known = solve_ivp(lambda t, y: np.log(y) - 1, (0, 0.5), [1.0], method="DOP853", rtol=1e-12, atol=1e-12).y[0, -1]
    np.testing.assert_allclose(sol.ys[-1], known, rtol=1e-7)
