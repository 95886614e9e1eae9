"""Derivatives with respect to the ends of the interval and to saved times, at the ends of steps too."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
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


# q = Q(t √a), so that ∂q/∂a = t v/2 and ∂v/∂a = (v + t v̇)/2 at a = 1.
PENDULUM = dae_jax.ConstrainedSystem(
    lambda t, q, v, a: a * jnp.array([0.0, 9.81]), constraint=lambda t, q, a: (q @ q - 1) / 2
)
TOLERANCE = 1e-10


def swung(solver, start=0.0, end=2.0, a=1.0, formulation=None, event=None, **saved):
    controller = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE)
    return dae_jax.daesolve(
        PENDULUM, solver, start, end, None, (jnp.array([1.0, 0.0]), jnp.zeros(2)), jnp.asarray(a),
        formulation=formulation, saveat=diffrax.SaveAt(**saved), stepsize_controller=controller, event=event,
    )  # fmt: skip


def rate_of(state):
    q, v = map(np.asarray, state)
    return v, np.array([0, 9.81]) - (np.sum(v * v, -1) + 9.81 * q[..., 1])[..., None] * q


def off(found, expected):
    """The largest difference, in tolerances."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(np.max(np.abs(np.asarray(a) - b)) for a, b in pairs) / TOLERANCE


METHODS = [
    (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
    (dae_jax.TangentSpace(diffrax.Tsit5()), None),
    (dae_jax.RadauIIA5(), None),
    (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
    (dae_jax.DOP853(), dae_jax.StateSpace(lambda z: jnp.stack([jnp.cos(z[0]), jnp.sin(z[0])]), jnp.zeros(1))),
]


@pytest.mark.parametrize(("solver", "formulation"), METHODS, ids=lambda x: type(x).__name__)
def test_what_is_saved_moves_by_the_rate_at_it(solver, formulation):
    """The slopes of what is between steps were 300 to 3,400 tolerances off."""
    times = jnp.linspace(0.1, 1.9, 7)
    at = lambda t0, t1, ts: swung(solver, t0, t1, formulation=formulation, ts=ts, t1=True).ys
    rate = rate_of(at(0.0, 2.0, times))
    of_saved, of_end = jax.tree.map(lambda x: x * (np.arange(8) < 7)[:, None], rate), jax.tree.map(lambda x: x[7], rate)
    assert off(jax.jvp(lambda ts: at(0.0, 2.0, ts), (times,), (jnp.ones(7),))[1], of_saved) < 10
    by_t1 = jax.jvp(lambda t1: at(0.0, t1, times), (2.0,), (1.0,))[1]
    assert off(jax.tree.map(lambda x: x[7], by_t1), of_end) < 10
    by_t0 = jax.jvp(lambda t0: at(t0, 2.0, times), (0.0,), (1.0,))[1]
    assert off(by_t0, jax.tree.map(np.negative, rate)) < 200
    backwards = jax.grad(lambda ts: sum(map(jnp.sum, at(0.0, 2.0, ts))))(times)
    assert off(backwards, sum(x[:7].sum(1) for x in rate)) < 10


@pytest.mark.parametrize("saved", [{"t0": True}, {"steps": True}, {"t0": True, "steps": 3, "t1": True}], ids=str)
@pytest.mark.parametrize("end", [2.0, -2.0])
def test_times_that_are_saved_beside(saved, end):
    """Each time moves its own row, one at t₀ and two that are the same among them."""
    times = jnp.array([0.0, 0.0, 0.2, 0.6, 0.6, 2.0]) * jnp.sign(end)
    solve = lambda ts: (lambda sol: (sol.ts, sol.ys))(swung(METHODS[0][0], 0.0, end, ts=ts, **saved))
    (ts, ys), (dts, dys) = jax.jvp(solve, (times,), (jnp.arange(1.0, 7.0),))
    moved = np.flatnonzero(dts)
    np.testing.assert_array_equal(dts[moved], np.arange(1, 7))
    np.testing.assert_array_equal(ts[moved], times)
    pick = lambda x: np.asarray(x)[moved]
    expected = jax.tree.map(lambda x: x * np.arange(1, 7)[:, None], rate_of(jax.tree.map(pick, ys)))
    assert off(jax.tree.map(pick, dys), expected) < 1
    assert not any(np.any(np.delete(np.asarray(x), moved, 0)) for x in dys)


@pytest.mark.parametrize("solver", [METHODS[0][0], METHODS[2][0]], ids=lambda s: type(s).__name__)
def test_functions_of_the_state_and_second_derivatives(solver):
    times = jnp.array([0.3, 1.1])
    of = lambda ts: swung(solver, ts=ts, fn=lambda t, y, a: {"x": t * y[0][0]}).ys["x"]
    q, v = swung(solver, ts=times).ys
    acceleration = rate_of((q, v))[1]
    assert off(jax.jacrev(of)(times), np.diag(q[:, 0] + times * v[:, 0])) < 1
    twice = jax.jvp(lambda ts: jax.jvp(of, (ts,), (jnp.ones(2),))[1], (times,), (jnp.ones(2),))[1]
    assert off(twice, 2 * v[:, 0] + times * acceleration[:, 0]) < 10


@pytest.mark.parametrize("solver", [METHODS[0][0], METHODS[2][0]], ids=lambda s: type(s).__name__)
def test_dense_output_moves_by_the_rate(solver):
    sol = swung(solver, dense=True)
    for t in (0.05, 0.7, 1.234):
        assert off(jax.jvp(sol.evaluate, (t,), (1.0,))[1], rate_of(sol.evaluate(t))) < 10
    by_t0 = jax.jvp(lambda t0: swung(solver, t0, dense=True).evaluate(1.234), (0.0,), (1.0,))[1]
    assert off(by_t0, jax.tree.map(np.negative, rate_of(sol.evaluate(1.234)))) < 20


@pytest.mark.parametrize("solver", [METHODS[0][0], METHODS[2][0]], ids=lambda s: type(s).__name__)
def test_the_time_of_an_event_and_what_comes_after_a_reset(solver):
    """By slopes the state at the event was 1,800 tolerances off, those after resets 1,100, by their times 2,600."""
    crossing = lambda t, y, a, **_: y[0][1] - 0.7
    event = diffrax.Event(crossing, optimistix.Bisection(1e-14, 1e-14, flip="detect"))

    def ended(a):
        sol = swung(solver, 0.0, 5.0, a, event=event, t1=True)
        return sol.ts[-1], sol.ys[0][-1], sol.ys[1][-1]

    (t, q, v), tangents = jax.jvp(ended, (1.0,), (1.0,))
    assert off(tangents, (-t / 2, 0 * q, v / 2)) < 10
    assert off(jax.grad(lambda a: ended(a)[0])(1.0), -t / 2) < 10

    times = jnp.array([0.1, 0.9, 2.0])
    reset = dae_jax.Reset(crossing, lambda t, y, a: ((y[0], -y[1]), a))
    turned = lambda a, ts: swung(solver, 0.0, 2.2, a, event=reset, ts=ts).ys
    q, v = turned(1.0, times)
    rate, t = rate_of((q, v)), np.array(times)[:, None]
    (q_by_a, q_by_times), (v_by_a, v_by_times) = jax.jacfwd(turned, (0, 1))(1.0, times)
    assert off((q_by_a, v_by_a), (t * v / 2, (v + t * rate[1]) / 2)) < 200
    assert off([np.einsum("iji->ij", x) for x in (q_by_times, v_by_times)], rate) < 10
