"""What is saved between steps is as accurate as the steps: for every variable, and on either side of a jump."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.solvers.residual_steps import Iteration, simplified_newton, tolerances


TOLERANCE = 1e-7
TIMES = np.linspace(0, 2, 301)
IMPLICIT = {"radau": dae_jax.RadauIIA5(), "bdf": dae_jax.BDF()}
FORMS = {"as written": None, "dummy derivatives": dae_jax.DummyDerivatives()}


def solved(system, solver, y0, saveat, formulation=None, tolerance=TOLERANCE, jump_ts=None):
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    if jump_ts is not None:
        control = diffrax.ClipStepSizeController(control, jump_ts=jnp.array(jump_ts))
    return dae_jax.daesolve(
        system, solver, 0.0, 2.0, None, y0, formulation=formulation, saveat=saveat, stepsize_controller=control,
        max_steps=20_000,
    )  # fmt: skip


def index_1(t, y, yd, args):
    """An algebraic variable that no derivative depends on."""
    return [yd[0] + y[0], y[1] - jnp.sin(20 * t)]


def index_2(t, y, yd, args):
    """y₀ is constant, y₁ is not."""
    return [yd[0] - y[1] + 20 * jnp.cos(20 * t), y[0] - 1]


def index_3(t, y, yd, args):
    """The force that moves a mass along a given path."""
    return [yd[0] - y[1], yd[1] - y[2], y[0] - jnp.sin(3 * t)]


EXACT = {
    index_1: lambda t: np.stack([np.exp(-t), np.sin(20 * t)], 1),
    index_2: lambda t: np.stack([np.ones_like(t), 20 * np.cos(20 * t)], 1),
    index_3: lambda t: np.stack([np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)], 1),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("solver", IMPLICIT)
@pytest.mark.parametrize("residual", EXACT, ids=lambda residual: residual.__name__)
def test_algebraic_variables_are_controlled_between_steps(residual, solver, form):
    exact = EXACT[residual]
    start = jnp.asarray(exact(np.zeros(1))[0])
    saveat = diffrax.SaveAt(ts=TIMES, dense=True)
    sol = solved(dae_jax.ImplicitDAE(residual), IMPLICIT[solver], start, saveat, FORMS[form])
    size = 1 + np.abs(exact(TIMES)).max(0)
    assert (np.abs(sol.ys - exact(TIMES)) / size).max() < 30 * TOLERANCE
    anywhere = np.linspace(0, 2, 7)[1:-1]
    found = np.stack([sol.evaluate(t) for t in anywhere])
    assert (np.abs(found - exact(anywhere)) / size).max() < 30 * TOLERANCE


def test_nothing_is_done_for_values_between_steps_that_nobody_wants():
    start = jnp.array([1.0, 0.0])
    steps = [
        int(solved(dae_jax.ImplicitDAE(index_1), dae_jax.RadauIIA5(), start, saveat).stats["num_steps"])
        for saveat in (diffrax.SaveAt(t1=True), diffrax.SaveAt(ts=TIMES))
    ]
    assert steps[0] < steps[1] / 3


@pytest.mark.parametrize("announced", [[1.0], None], ids=["announced", "unannounced"])
@pytest.mark.parametrize("solver", IMPLICIT)
def test_no_value_is_between_the_two_sides_of_a_jump(solver, announced):
    """A switched source: x' = z − x, z = u(t). Where the jump is not announced, its time is found to the tolerance only: z may
    rise within a step that changes x by less.
    """
    u = lambda t: jnp.where(t < 1, 0.0, 1.0)
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: z - x, lambda t, x, z, args: z - u(t))
    near = 10.0 ** -np.arange(3, 13 if announced else 7, 3)
    times = np.sort(np.concatenate([[0.5, 1.0, 2.0], 1 - near, 1 + near]))
    start = (jnp.zeros(()), jnp.zeros(()))
    x, z = solved(system, IMPLICIT[solver], start, diffrax.SaveAt(ts=times), jump_ts=announced).ys
    np.testing.assert_allclose(x, np.where(times < 1, 0, -np.expm1(1 - times)), atol=2e-6)
    away = times != 1
    np.testing.assert_allclose(z[away], u(times)[away], atol=1e-12)
    if announced:
        assert np.abs(z[~away] - np.array([0.0, 1.0])).min() < 1e-12


def test_one_correction_does_not_count_as_a_solution_because_the_step_before_converged_fast():
    tol = tolerances(1e-6, 1e-6, jnp.float64)._replace(corrections=50)
    # The matrix is of another regime: half the error is left by each correction.
    half_way = Iteration(lambda x: x - 1, lambda off: -off / 2, lambda off: off, jnp.zeros(1), jnp.inf)
    start = jnp.array([1e-3])
    found = simplified_newton(
        half_way, start, half_way.residual(start), 1 / tol.scale(jnp.ones(1)), jnp.asarray(1e-12), tol
    )
    assert found.converged
    assert abs(float(found.x[0]) - 1) < 1e-7


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("solver", IMPLICIT)
def test_at_the_end_a_variable_that_follows_from_a_derivative_is_right(solver, dtype):
    """x is prescribed, so that nothing of z is seen in its error."""
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: [yd[0] + y[0] - y[1], y[0] - jnp.sin(7 * t)])
    tolerance = 1e-7 if dtype == jnp.float64 else 1e-4
    start = jnp.array([0.0, 7.0], dtype)
    end = solved(system, IMPLICIT[solver], start, diffrax.SaveAt(t1=True), tolerance=tolerance).ys[-1]
    exact = np.array([np.sin(14.0), np.sin(14.0) + 7 * np.cos(14.0)])
    # Round-off grows like 1/h in variables of index 2; where float32 has no more digits the tolerance does, too.
    np.testing.assert_allclose(end, exact, atol=100 * tolerance if dtype == jnp.float64 else 0.1)
