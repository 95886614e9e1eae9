"""Answers that no step has failed for, and that are not to be trusted: a warning says so, and `stats["doubts"]`."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import pytest

import dae_jax
from dae_jax import AccuracyWarning, ConstrainedSystem, OrthogonalProjection
from dae_jax.driver import doubts
from dae_jax.scenes import pendulum


TSIT5 = OrthogonalProjection(diffrax.Tsit5())
START = (jnp.array([1.0, 0.0]), jnp.zeros(2))


def spring(omega):
    """Along a straight line."""
    return ConstrainedSystem(lambda t, q, v, args: -(omega**2) * q * jnp.array([1.0, 0.0]), lambda t, q, args: q[1])


def solved(system, solver=TSIT5, t1=5.0, dt0=1e-3, y0=START, **options):
    return dae_jax.daesolve(system, solver, 0.0, t1, dt0, y0, None, max_steps=None, **options)


def of(sol):
    return int(sol.stats["doubts"])


@pytest.mark.parametrize("solver", [TSIT5, diffrax.Tsit5(), diffrax.Dopri5()], ids=lambda s: type(s).__name__)
def test_fixed_steps_beyond_the_limit_of_stability(solver):
    with pytest.warns(AccuracyWarning, match="fixed steps are too large"):
        sol = solved(spring(1500.0), solver)
    assert of(sol) == 2
    assert not float(jnp.max(jnp.abs(sol.ys[0]))) < 1.1
    assert of(solved(spring(50.0), solver)) == 0


def test_drift_beyond_the_tolerances():
    scene = pendulum()
    with pytest.warns(AccuracyWarning, match="drift"):
        sol = solved(scene.system, diffrax.Tsit5(), 500.0, None, scene.y0)
    assert of(sol) == 1
    assert float(dae_jax.drift(scene.system, sol).position[-1]) > 1e-5
    assert of(solved(scene.system, TSIT5, 100.0, None, scene.y0)) == 0


def test_very_many_steps(monkeypatch):
    monkeypatch.setattr(doubts, "MANY", 100)
    control = {"stepsize_controller": diffrax.PIDController(rtol=1e-4, atol=1e-4)}
    with pytest.warns(AccuracyWarning, match="million steps"):
        assert of(solved(spring(3.0), TSIT5, 100.0, None, **control)) == 4
    few = solved(spring(3.0), TSIT5, 5.0, None, **control)
    assert (of(few), int(few.stats["num_accepted_steps"]) < 100) == (0, True)


def test_in_a_batch_and_under_jit_it_is_a_number():
    run = lambda omega: solved(spring(omega)).stats["doubts"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.vmap(run)(jnp.array([50.0, 1500.0])).tolist() == [0, 2]
        assert int(jax.jit(run)(1500.0)) == 2


def test_a_solve_that_failed_has_none():
    sol = solved(spring(1e6), throw=False)
    assert int(sol.result._value) != 0
    assert of(sol) == 0


CUBE_ROOT = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -jnp.ones(1), lambda t, x, z, a: z**3 - x)
ON_A_SPHERE = dae_jax.ImplicitDAE(
    lambda t, y, yd, a: jnp.stack([yd[0] - y[1], yd[1] + y[0] * y[2], y[0] ** 2 + y[1] ** 2 + y[2] ** 2 - 3])
)


@pytest.mark.parametrize("dt0", [0.1, 0.013])
def test_equations_that_do_not_hold_at_the_end(dt0):
    """z = x^(1/3) through 0, where the underlying ODE has a pole that fixed steps leap over."""
    with pytest.raises(RuntimeError, match="does not satisfy the constraints at its end"):
        dae_jax.daesolve(CUBE_ROOT, diffrax.Tsit5(), 0.0, 2.0, dt0, (jnp.ones(1), jnp.ones(1)))


def test_drift_off_equations_beyond_the_tolerances():
    loose = diffrax.PIDController(rtol=3e-5, atol=3e-5)
    solve = lambda solver, t1: solved(ON_A_SPHERE, solver, t1, None, jnp.ones(3), stepsize_controller=loose)
    with pytest.warns(AccuracyWarning, match="drift"):
        sol = solve(diffrax.Tsit5(), 3e5)
    assert of(sol) == 1
    assert float(dae_jax.drift(ON_A_SPHERE, sol).levels[0][-1]) > 1
    assert of(solve(TSIT5, 1e4)) == 0
    assert of(solved(ON_A_SPHERE, dae_jax.RadauIIA5(), 100.0, None, jnp.ones(3))) == 0
