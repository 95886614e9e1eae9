"""What is saved of steps has the derivative of these very steps, whatever program computes it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


# Motions from rest in another field are the same in another time.
SYSTEM = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, -g]), lambda t, q, g: (q @ q - 1) / 2)
Y0 = (jnp.array([1.0, 0.0]), jnp.zeros(2))
FIELD, END = 9.81, 3.0
METHODS = {
    "projection": (dae_jax.OrthogonalProjection(diffrax.Tsit5()), None),
    "Radau": (dae_jax.RadauIIA5(), None),
    "BDF": (dae_jax.BDF(), None),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
}


def solve(field, method, saveat, **options):
    solver, formulation = METHODS[method]
    options = {"stepsize_controller": diffrax.PIDController(rtol=1e-11, atol=1e-11), "max_steps": 2**13, **options}
    return dae_jax.daesolve(
        SYSTEM, solver, 0.0, END, None, Y0, field, formulation=formulation, saveat=saveat, **options
    )


def slope(t, sol_v):
    """q at the time t depends on t √g alone."""
    return t[:, None] * sol_v / (2 * FIELD)


@pytest.mark.parametrize("method", METHODS)
def test_at_each_step(method):
    def steps(field):
        sol = solve(field, method, diffrax.SaveAt(steps=True))
        return sol.ts, *sol.ys

    (t, _, v), (_, dq, _) = jax.jvp(steps, (FIELD,), (1.0,))
    reached = np.isfinite(t)
    # Steps of derivatives may be shorter than those of the solution, and are not longer.
    assert reached.sum() >= np.isfinite(solve(FIELD, method, diffrax.SaveAt(steps=True)).ts).sum() >= 80
    np.testing.assert_allclose(dq[reached], slope(t[reached], v[reached]), atol=3e-8)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_of_dense_output(derivative):
    times = jnp.linspace(0.1, END, 30)

    def between(field):
        sol = solve(field, "Radau", diffrax.SaveAt(dense=True), max_steps=2**14)
        return jax.vmap(sol.evaluate)(times)

    _, v = between(FIELD)
    np.testing.assert_allclose(derivative(lambda g: between(g)[0])(FIELD), slope(times, v), atol=3e-8)


STEPS = diffrax.PIDController(rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("case", ["backwards", "event", "jump", "batch"])
def test_wherever_a_solve_ends(case):
    """Backwards; at an event, within the last step; over a time that steps end at; in lanes of other numbers of steps."""
    options = {
        "event": {"event": diffrax.Event(lambda t, y, args, **kwargs: t - 0.77)},
        "jump": {"stepsize_controller": diffrax.ClipStepSizeController(STEPS, jump_ts=jnp.array([0.3]))},
    }.get(case, {})
    t1, end = (-1.0, -1.0) if case == "backwards" else (1.0, 0.77) if case == "event" else (1.0, 1.0)
    times = jnp.linspace(0.05, 1.0, 9) * end

    def between(field):
        sol = dae_jax.daesolve(
            SYSTEM, dae_jax.OrthogonalProjection(diffrax.Tsit5()), 0.0, t1, None, Y0, field, max_steps=2**11,
            saveat=diffrax.SaveAt(dense=True), **{"stepsize_controller": STEPS, **options},
        )  # fmt: skip
        return jax.vmap(sol.evaluate)(times)

    fields = jnp.array([FIELD / 2, FIELD, 2 * FIELD]) if case == "batch" else jnp.array([FIELD])
    slopes = (
        jax.vmap(jax.jacrev(lambda g: between(g)[0]))(fields)
        if case == "batch"
        else [jax.jacrev(lambda g: between(g)[0])(FIELD)]
    )
    for field, found in zip(fields, slopes, strict=True):
        np.testing.assert_allclose(found, times[:, None] * between(field)[1] / (2 * field), atol=1e-7)


@pytest.mark.parametrize("length", [1e3, 1e4])
def test_a_step_in_which_newton_fails_by_round_off_alone(length):
    """In the program of the reverse derivative one of the steps seemed to diverge, and the derivative was 0."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, a: jnp.array([0.0, 9.81]), lambda t, q, a: (q @ q - length**2) / 2
    )
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8)

    def angle(start, adjoint):
        y0 = length * jnp.stack([jnp.sin(start), jnp.cos(start)]), jnp.zeros(2)
        sol = dae_jax.daesolve(
            system, dae_jax.RadauIIA5(), 0.0, 0.4 * length**0.5, None, y0, stepsize_controller=control,
            adjoint=adjoint, event=diffrax.Event(lambda t, y, args, **kwargs: y[0][0] - 1e9),
        )  # fmt: skip
        return jnp.arctan2(*sol.ys[0][-1])

    found = jax.grad(angle)(-0.7, diffrax.RecursiveCheckpointAdjoint())
    np.testing.assert_allclose(found, 0.43072713, rtol=1e-6)
    np.testing.assert_allclose(found, jax.jacfwd(angle)(-0.7, diffrax.ForwardMode()), rtol=1e-6)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("event", [False, True])
@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5, dae_jax.BDF])
def test_a_step_that_fails_in_the_derivative_alone(solver, event, mode, monkeypatch):
    """There is no derivative then; it was that of the steps before it, or after it, or 0."""
    as_it_was = solver.step

    def step(self, terms, t0, t1, y0, args, *state):
        y1, error, dense, new, result = as_it_was(self, terms, t0, t1, y0, args, *state)
        fails = args.patient & (t0 < 0.5) & (t1 >= 0.5)
        result = diffrax.RESULTS.where(fails, diffrax.RESULTS.nonlinear_divergence, result)
        return jnp.where(fails, jnp.nan, y1), jnp.where(fails, jnp.inf, error), dense, new, result

    monkeypatch.setattr(solver, "step", step)
    system = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, g]), lambda t, q, g: (q @ q - 1) / 2)

    def height(g):
        sol = dae_jax.daesolve(
            system, solver(), 0.0, 1.0, None, (jnp.array([1.0, 0.0]), jnp.zeros(2)), g,
            adjoint=diffrax.ForwardMode() if mode is jax.jacfwd else diffrax.RecursiveCheckpointAdjoint(),
            event=diffrax.Event(lambda t, y, g, **kwargs: y[0][0] - 50) if event else None,
        )  # fmt: skip
        return sol.ys[0][-1, 1]

    assert jnp.isfinite(height(9.81))
    assert jnp.isnan(mode(height)(9.81))
