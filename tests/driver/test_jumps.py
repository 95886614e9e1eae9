"""Solves that start again after an event: where it is, what comes after, derivatives and batches through it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import dae_jax
from dae_jax.equations.residual_form import LARGE
from dae_jax.scenes import pendulum


GRAVITY = 9.81
# A ball on a vertical wire: x = 0.
BALL = dae_jax.ConstrainedSystem(lambda t, q, v, e: jnp.array([0.0, -GRAVITY]), lambda t, q, e: q[0])
RELEASED = (jnp.array([0.0, 1.0]), jnp.zeros(2))
BOUNCE = dae_jax.Reset(lambda t, y, e, **_: y[0][1], lambda t, y, e: ((y[0], -e * y[1]), e), direction=False)


def bouncing(e, t1, adjoint=None, solver=None, **options):
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    solver = diffrax.Tsit5() if solver is None else solver
    return dae_jax.daesolve(BALL, solver, 0.0, t1, None, RELEASED, e, event=BOUNCE, adjoint=adjoint, **options)


def bounces(e):
    """The times of the first three."""
    fall = np.sqrt(2 / GRAVITY)
    return fall * np.array([1, 1 + 2 * e, 1 + 2 * e + 2 * e**2])


def height(e, t):
    """Between the third bounce and the fourth."""
    since = t - bounces(e)[2]
    return e**3 * np.sqrt(2 * GRAVITY) * since - GRAVITY / 2 * since**2


@pytest.mark.parametrize(
    "solver", [diffrax.Tsit5(), dae_jax.OrthogonalProjection(dae_jax.DOP853()), dae_jax.RadauIIA5()]
)
def test_a_ball_bounces_when_it_should(solver):
    sol = bouncing(0.9, 2.2, solver=solver, saveat=diffrax.SaveAt(t0=True, ts=np.array([0.3, 2.1]), t1=True))
    assert sol.stats["jumps"] == 3
    np.testing.assert_allclose(sol.stats["jump_times"][:3], bounces(0.9), atol=1e-9)
    assert np.isinf(sol.stats["jump_times"][3:]).all()
    np.testing.assert_array_equal(sol.ts, [0.0, 0.3, 2.1, 2.2])
    exact = [1.0, 1 - GRAVITY / 2 * 0.09, height(0.9, 2.1), height(0.9, 2.2)]
    np.testing.assert_allclose(sol.ys[0][:, 1], exact, atol=1e-8)


@pytest.mark.parametrize("solver", [dae_jax.OrthogonalProjection(diffrax.Tsit5()), dae_jax.RadauIIA5()])
def test_in_single_precision_among_double_ones(solver):
    """States of float32 where x64 is on: after a bounce, and the time of an event."""
    y0, e = (jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), x) for x in (RELEASED, 0.9))
    solve = lambda t1, event: dae_jax.daesolve(BALL, solver, 0.0, t1, None, y0, e, event=event)
    (q, _), landing = solve(2.1, BOUNCE).final, lambda t, y, e, **_: y[0][1]
    assert q.dtype == jnp.float32
    assert q[1] == pytest.approx(height(0.9, 2.1), abs=1e-4)
    event = diffrax.Event(landing, optimistix.Newton(1e-5, 1e-5))
    assert solve(2.1, event).ts[-1] == pytest.approx(bounces(0.9)[0], abs=1e-5)


def test_derivatives_through_jumps():
    end = lambda e, adjoint: bouncing(e, 2.2, adjoint).ys[0][-1, 1]
    h = 1e-6
    exact = (height(0.9 + h, 2.2) - height(0.9 - h, 2.2)) / (2 * h)
    reverse = jax.grad(lambda e: end(e, diffrax.RecursiveCheckpointAdjoint()))(0.9)
    forward = jax.jacfwd(lambda e: end(e, diffrax.ForwardMode()))(0.9)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    np.testing.assert_allclose(forward, exact, rtol=1e-6)


@pytest.mark.parametrize(
    "order",
    [jax.hessian, lambda f: jax.grad(jax.grad(f)), lambda f: jax.jacfwd(jax.jacfwd(f))],
    ids=["hessian", "gradients", "forward"],
)
def test_second_derivatives_through_jumps_without_another_adjoint(order):
    h = 1e-4
    exact = (height(0.9 + h, 2.2) - 2 * height(0.9, 2.2) + height(0.9 - h, 2.2)) / h**2
    np.testing.assert_allclose(order(lambda e: bouncing(e, 2.2).ys[0][-1, 1])(0.9), exact, rtol=1e-5)


def test_forward_derivatives_are_those_of_the_default_adjoint():
    end = lambda e: bouncing(e, 2.2).ys[0][-1, 1]
    _, forward = jax.jvp(end, (0.9,), (1.0,))
    np.testing.assert_allclose(forward, jax.grad(end)(0.9), rtol=1e-12)


def test_forward_derivatives_beside_an_integer():
    """A count in `args`, which has no tangent."""
    wire = dae_jax.ConstrainedSystem(lambda t, q, v, a: jnp.stack([-a["g"], 0 * a["g"]]), lambda t, q, a: q[1])
    counted = lambda t, y, a: ((y[0], -0.8 * y[1]), {**a, "n": a["n"] + 1})
    bounce = dae_jax.Reset(lambda t, y, a, **_: y[0][0], counted, direction=False)

    def end(g):
        y0, args = (jnp.array([1.0, 0.0]), jnp.zeros(2)), {"g": g, "n": 3}
        return dae_jax.daesolve(
            wire, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.0, None, y0, args, event=bounce
        ).ys[0][-1, 0]

    # One bounce at √(2/g), with 0.8 of the speed.
    exact = lambda g: 0.8 * jnp.sqrt(2 * g) * (1 - jnp.sqrt(2 / g)) - g / 2 * (1 - jnp.sqrt(2 / g)) ** 2
    np.testing.assert_allclose(jax.jacfwd(end)(9.0), jax.grad(exact)(9.0), rtol=1e-9)
    np.testing.assert_allclose(jax.hessian(end)(9.0), jax.hessian(exact)(9.0), rtol=1e-8)


def test_batch_is_one_at_a_time():
    end = lambda e: bouncing(e, 2.2).ys[0][-1, 1]
    together = jax.vmap(lambda e: bouncing(e, 2.2, throw=False))(jnp.array([0.2, 0.8, 0.9]))
    np.testing.assert_allclose(together.ys[0][1:, -1, 1], [end(0.8), end(0.9)], rtol=1e-10, atol=1e-12)
    assert list(together.result == dae_jax.RESULTS.successful) == [False, True, True]
    with pytest.raises(RuntimeError, match="more resets"):
        end(0.2)


def test_a_ball_that_comes_to_rest_is_reported():
    sol = bouncing(0.5, 10.0, throw=False)
    assert sol.result == dae_jax.RESULTS.too_many_jumps
    found = np.asarray(sol.stats["jump_times"])
    np.testing.assert_allclose(found[np.isfinite(found)][-1], np.sqrt(2 / GRAVITY) * 3, atol=1e-8)


def test_pendulum_with_a_stop_at_its_lowest_point():
    """An elastic stop: it comes back to where it was released, and hits the stop every half period."""
    scene = pendulum()
    stop = dae_jax.Reset(lambda t, y, args, **_: y[0][0], lambda t, y, args: ((y[0], -y[1]), args))
    quarter = ellipk(0.5) / np.sqrt(GRAVITY)
    sol = dae_jax.daesolve(
        scene.system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 6 * quarter, None, scene.y0, event=stop,
        saveat=diffrax.SaveAt(ts=[2 * quarter, 6 * quarter]),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )  # fmt: skip
    np.testing.assert_allclose(sol.stats["jump_times"][:3], quarter * np.array([1, 3, 5]), atol=1e-8)
    np.testing.assert_allclose(sol.ys[0], [[1.0, 0.0], [1.0, 0.0]], atol=1e-7)
    assert dae_jax.drift(scene.system, sol).position.max() < 1e-13


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()])
def test_a_crossing_of_an_algebraic_variable_is_one_jump(solver):
    """Nothing happens at it, so that the next part starts at zero, which z leaves upwards or downwards."""
    system = dae_jax.SemiExplicitDAE(lambda t, x, z, args: jnp.stack([x[1], -x[0]]), lambda t, x, z, args: z - x[0])
    count = dae_jax.Reset(lambda t, y, args, **_: y[1], lambda t, y, args: (y, args), max_resets=5)
    sol = dae_jax.daesolve(system, solver, 0.0, 9.0, None, (jnp.array([1.0, 0.0]), jnp.array(1.0)), event=count)
    assert sol.stats["jumps"] == 3
    np.testing.assert_allclose(sol.stats["jump_times"][:3], np.pi * np.array([0.5, 1.5, 2.5]), atol=1e-6)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()])
def test_a_diode_switches(solver):
    """C u̇ = i − u/R; on: i = (E − u)/r, off: i = 0. It switches where i, or u − E, falls through zero."""
    supply, c, r_load, r_on = (lambda t: jnp.sin(2 * t)), 1.0, 5.0, 0.1
    f = lambda t, x, z, on: (z - x / r_load) / c
    g = lambda t, x, z, on: z - on * (supply(t) - x) / r_on
    switch = dae_jax.Reset(
        lambda t, y, on, **_: jnp.where(on > 0, y[1][0], y[0][0] - supply(t)),
        lambda t, y, on: (y, 1 - on),
        direction=False,
    )
    sol = dae_jax.daesolve(
        dae_jax.SemiExplicitDAE(f, g), solver, 0.0, 9.0, None, (jnp.zeros(1), jnp.zeros(1)), 1.0, event=switch,
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9), max_steps=20_000,
    )  # fmt: skip
    # The field has a kink only, so a tight solve needs no events.
    field = lambda t, u: (max(np.sin(2 * t) - u[0], 0) / r_on - u[0] / r_load) / c
    tight = solve_ivp(field, (0, 9), [0.0], "DOP853", rtol=1e-12, atol=1e-13, max_step=0.005, dense_output=True)
    assert sol.stats["jumps"] == 5
    assert abs(float(sol.ys[0][-1, 0]) - tight.y[0, -1]) < 1e-7
    at = np.asarray(sol.stats["jump_times"][:5])
    np.testing.assert_allclose(tight.sol(at)[0], np.sin(2 * at), atol=1e-7)


@pytest.mark.parametrize("finder", [optimistix.Newton(1e-10, 1e-10), optimistix.Bisection(1e-10, 1e-10)])
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.RadauIIA5(), dae_jax.BDF()])
def test_an_event_of_diffrax_ends_the_solve(solver, finder):
    event = diffrax.Event(lambda t, y, args, **_: y[0][1] - 0.25, finder)
    sol = dae_jax.daesolve(BALL, solver, 0.0, 2.0, None, RELEASED, event=event)
    assert sol.result == dae_jax.RESULTS.event_occurred
    np.testing.assert_allclose(sol.ts, [np.sqrt(1.5 / GRAVITY)], atol=1e-7)


def test_refusals():
    with pytest.raises(ValueError, match="no steps or dense output"):
        bouncing(0.9, 2.0, saveat=diffrax.SaveAt(steps=True))
    with pytest.raises(ValueError, match="use OrthogonalProjection"):
        bouncing(0.9, 2.0, solver=dae_jax.TangentSpace(diffrax.Tsit5()))
    away = dae_jax.Reset(lambda t, y, e, **_: y[0][1], lambda t, y, e: ((y[0] * jnp.nan, y[1]), e))
    sol = dae_jax.daesolve(BALL, diffrax.Tsit5(), 0.0, 2.0, None, RELEASED, 0.9, event=away, throw=False)
    assert sol.result == dae_jax.RESULTS.inconsistent_reset


def held_or_pulled(t, y, yd, held):
    """A mass on a spring, drawn at a constant speed while `held` is 1, by a constant force while it is 0."""
    return [yd["x"] - y["v"], yd["v"] + 10 * y["x"] - y["f"], held * (y["v"] - 0.5) + (1 - held) * (y["f"] - 4)]


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()], ids=["radau", "bdf"])
def test_a_condition_on_an_algebraic_variable_that_the_structure_does_not_give(solver):
    """f = 10 x = 5 t while it is held: at f = 5.886 it lets go, and swings until its speed is 0.5 again."""
    zero = jnp.zeros(())
    start = {"x": zero, "v": zero + 0.5, "f": zero}
    solve = lambda event: dae_jax.daesolve(
        dae_jax.ImplicitDAE(held_or_pulled), solver, 0.0, 3.0, None, start, 1.0, event=event
    )
    passed = solve(dae_jax.Reset(lambda t, y, held, **_: 5.886 - y["f"], lambda t, y, held: (y, held)))
    assert passed.stats["jumps"] == 1
    np.testing.assert_allclose(passed.stats["jump_times"][0], 1.1772, atol=1e-7)
    np.testing.assert_allclose(passed.ys["f"], 15.0, atol=1e-6)

    condition = lambda t, y, held, **_: jnp.where(held > 0.5, 5.886 - y["f"], 0.5 - y["v"])
    jump = lambda t, y, held: ({**y, "f": jnp.where(held > 0.5, 4.0, y["f"])}, 1 - held)
    switched = solve(dae_jax.Reset(condition, jump))
    # x − 0.4 turns by the angle ω t in the plane of (x − 0.4, v/ω), from (0.1886, 0.5/ω) until v is 0.5 again: the arc
    # that is left of a full turn.
    omega, at = np.sqrt(10), 5.886 / 10 - 0.4
    arc = 2 * np.pi - 2 * np.arctan2(at, 0.5 / omega)
    np.testing.assert_allclose(switched.stats["jump_times"][:2], [1.1772, 1.1772 + arc / omega], atol=2e-6)
    assert switched.stats["jumps"] == 2


def test_a_condition_is_a_number_that_crosses_zero():
    event = dae_jax.Reset(lambda t, y, args, **_: y[0][1] < 0, lambda t, y, args: (y, args))
    with pytest.raises(ValueError, match=r"must return a real number, whose zero is the event, but returns .*bool"):
        dae_jax.daesolve(BALL, diffrax.Tsit5(), 0.0, 1.0, None, RELEASED, event=event)


@pytest.mark.parametrize("direction", [None, True, False])
def test_a_condition_that_is_no_number_is_an_error(direction):
    """NaN has no sign: nothing would be seen of it."""
    condition = lambda t, y, args, **_: jnp.where(t > 0.4, jnp.nan, (-1.0 if direction else 1.0) * (1 + t))
    solve = lambda event: dae_jax.daesolve(BALL, diffrax.Tsit5(), 0.0, 1.0, None, RELEASED, event=event, throw=False)
    ended = solve(diffrax.Event(condition, direction=direction))
    assert ended.result == dae_jax.RESULTS.undefined_condition
    went_on = solve(dae_jax.Reset(condition, lambda t, y, args: (y, args), direction=direction))
    assert went_on.result not in (dae_jax.RESULTS.successful, dae_jax.RESULTS.event_occurred)


def test_a_condition_that_is_no_number_within_a_step_is_said_to_be_so():
    """Where a root finder looks, not only where the solve ends."""
    system = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd + y)
    event = diffrax.Event(
        lambda t, y, args, **kwargs: jnp.where(abs(t - 0.5) < 0.05, jnp.nan, t - 0.5), optimistix.Newton(1e-8, 1e-8)
    )
    ended = dae_jax.daesolve(system, diffrax.Tsit5(), 0.0, 1.0, 0.2, np.ones(1), event=event, throw=False)
    assert ended.result == dae_jax.RESULTS.undefined_condition


def test_a_state_that_is_no_number_is_no_event():
    """The step after t = 0.5 fails, and with it the condition."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.where(t > 0.5, jnp.nan, -GRAVITY) * jnp.array([0.0, 1.0]), lambda t, q, args: q[0]
    )
    event = diffrax.Event(lambda t, y, args, **_: y[0][1] + 10.0)
    for solver in (diffrax.Tsit5(), dae_jax.OrthogonalProjection(diffrax.Tsit5())):
        sol = dae_jax.daesolve(system, solver, 0.0, 1.0, 0.1, RELEASED, event=event, throw=False)
        assert sol.result not in (dae_jax.RESULTS.successful, dae_jax.RESULTS.event_occurred)


def test_the_former_name_warns():
    condition, bounced = lambda t, y, args, **_: y[0][1], lambda t, y, args: (y, args)
    with pytest.warns(DeprecationWarning, match="is called `Reset"):
        old = dae_jax.Jump(condition, bounced, most=3)
    assert isinstance(old, dae_jax.Reset)
    assert (old.condition, old.reset, old.max_resets) == (condition, bounced, 3)


def held(**others):
    """A pendulum whose bob becomes heavier at t = 0.3, or its rod longer."""
    system = dae_jax.ConstrainedSystem(
        lambda t, q, v, a: jnp.array([0.0, -GRAVITY * a["m"]]),
        lambda t, q, a: (q @ q - a["l"] ** 2) / 2,
        mass=lambda q, a: a["m"] * jnp.eye(2),
        potential=lambda q, a: GRAVITY * a["m"] * q[1],
    )
    return system, lambda reset: dae_jax.daesolve(
        system, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.0, None,
        (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), {"m": jnp.array(1.0), "l": jnp.array(1.0), **others},
        event=dae_jax.Reset(lambda t, y, a, **_: t - 0.3, reset), saveat=diffrax.SaveAt(ts=np.linspace(0, 1, 6)),
    )  # fmt: skip


def test_what_a_reset_changes_of_the_args_counts_in_diagnostics():
    system, solve = held(name="bob")
    sol = solve(lambda t, y, a: (y, {**a, "m": 3 * a["m"]}))
    (q, v), mass = sol.ys, np.where(sol.ts < 0.3, 1.0, 3.0)
    np.testing.assert_array_equal(sol.changed["m"], mass)
    assert sol.changed["l"] is None
    height, speed = np.asarray(q[:, 1]), np.sum(np.asarray(v) ** 2, 1)
    pull = mass * (speed - GRAVITY * height)
    np.testing.assert_allclose(dae_jax.multipliers(system, sol)[:, 0], pull, rtol=1e-9)
    np.testing.assert_allclose(dae_jax.energy(system, sol), mass * (speed / 2 + GRAVITY * height), rtol=1e-9)
    longer = solve(lambda t, y, a: ((2 * y[0], y[1]), {**a, "l": 2 * a["l"]}))
    np.testing.assert_allclose(jnp.linalg.norm(longer.ys[0], axis=1), np.where(longer.ts < 0.3, 1.0, 2.0), atol=1e-12)
    assert float(dae_jax.drift(system, longer).position.max()) < 1e-14


def test_the_args_of_each_lane_count_in_diagnostics():
    system, solve = held()
    batch = jax.vmap(lambda by: solve(lambda t, y, a: (y, {**a, "m": by * a["m"]})))(jnp.array([2.0, 3.0]))
    for k, by in enumerate((2.0, 3.0)):
        one = solve(lambda t, y, a, by=by: (y, {**a, "m": by * a["m"]}))
        np.testing.assert_allclose(dae_jax.energy(system, batch)[k], dae_jax.energy(system, one), rtol=1e-9)


def test_a_reset_that_would_cut_off_what_it_returns_is_refused():
    ramp = dae_jax.ImplicitDAE(lambda t, y, yd, a: yd - a)
    faster = dae_jax.Reset(lambda t, y, a, **_: t - 1, lambda t, y, a: (y, a * 1.5))
    solve = lambda a: dae_jax.daesolve(ramp, dae_jax.DOP853(), 0.0, 2.0, None, jnp.zeros(1), a, event=faster)
    with pytest.raises(ValueError, match=r"returns float64.* that is int.*: it would be cut off. Start with 1.0"):
        solve(1)
    np.testing.assert_allclose(solve(1.0).ys, [[2.5]], rtol=1e-12)


FLIP = lambda t, y, a: ((y[0], -y[1]), a)
FINDER = optimistix.Bisection(1e-12, 1e-12, flip="detect")
THROWN = (jnp.array([0.0, 0.1]), jnp.array([0.0, -3.0]))


def thrown(event, solver=None, t0=2.0, t1=0.0, **options):
    solver = dae_jax.OrthogonalProjection(dae_jax.DOP853()) if solver is None else solver
    return dae_jax.daesolve(BALL, solver, t0, t1, None, THROWN, event=event, **options)


def by_scipy(condition, t0, t1):
    """The first crossing, of a fall from `THROWN`, and the height there."""
    condition.terminal = True
    fall = lambda t, z: [z[1], -GRAVITY]
    found = solve_ivp(fall, (t0, t1), [0.1, -3.0], events=condition, rtol=1e-12, atol=1e-12, max_step=0.01)
    return found.t[-1], found.y[0, -1]


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.RadauIIA5(), dae_jax.BDF()], ids=["tsit", "radau", "bdf"])
def test_conditions_know_the_time_in_a_solve_backwards(solver):
    level = lambda t, y, a, **_: y[0][1] - 0.2 * t
    time, height = by_scipy(lambda t, z: z[0] - 0.2 * t, 2.0, 0.0)
    sol = thrown(diffrax.Event(level, FINDER), solver)
    np.testing.assert_allclose((sol.ts[-1], sol.ys[0][-1, 1]), (time, height), atol=1e-8)
    sol = thrown(dae_jax.Reset(lambda t, y, a, **_: t - 1.5, FLIP), solver)
    assert sol.stats["jumps"] == 1
    np.testing.assert_allclose(sol.stats["jump_times"][0], 1.5, atol=1e-9)
    np.testing.assert_allclose(sol.ys[1][-1, 1], -(-3 + GRAVITY * 0.5) + GRAVITY * 1.5, atol=1e-8)


def test_a_solve_backwards_leaves_the_reset_where_it_started():
    """The condition is zero at the start, and would be found again there."""
    sol = thrown(dae_jax.Reset(lambda t, y, a, **_: y[0][1] - 0.1, FLIP, max_resets=2), t1=1.7)
    assert sol.stats["jumps"] == 0
    np.testing.assert_allclose(sol.ys[0][-1, 1], 0.1 + 0.9 - GRAVITY / 2 * 0.09, atol=1e-9)


@pytest.mark.parametrize(
    "solver", [diffrax.Tsit5(), dae_jax.OrthogonalProjection(dae_jax.DOP853()), dae_jax.RadauIIA5(), dae_jax.BDF()]
)
def test_a_condition_that_crosses_and_comes_back_within_a_step(solver):
    """A ball thrown up passes a height twice; without the condition, the solve is one long step."""
    up = (jnp.zeros(2), jnp.array([0.0, 3.0]))
    solve = lambda event, **options: dae_jax.daesolve(BALL, solver, 0.0, 0.6, None, up, event=event, **options)
    top = 9 / (2 * GRAVITY)
    for below in (0.1, 1e-3):
        event = diffrax.Event(lambda t, y, a, **_: y[0][1] - (top - below), FINDER)  # noqa: B023
        first = (3 - np.sqrt(2 * GRAVITY * below)) / GRAVITY
        np.testing.assert_allclose(solve(event).ts[-1], first, atol=1e-6)
    never = diffrax.Event(lambda t, y, a, **_: y[0][1] - (top + 1e-3), FINDER)
    assert solve(never).ts[-1] == 0.6


@pytest.mark.parametrize("order", [0, 1])
def test_the_first_of_two_events_within_a_step(order):
    """Whatever their order in the list; two at one time are one."""
    at = lambda when: lambda t, y, a, **_: t - when
    finder = optimistix.Newton(1e-10, 1e-10)
    conditions = [at(1.5), at(1.2)] if order else [at(1.2), at(1.5)]
    sol = thrown(diffrax.Event(conditions, finder), t0=2.0, t1=0.0)
    np.testing.assert_allclose(sol.ts[-1], 1.5, atol=1e-10)
    assert [bool(x) for x in sol.event_mask] == [bool(order), not order]
    both = thrown(diffrax.Event([at(1.5), at(1.5)], finder))
    np.testing.assert_allclose(both.ts[-1], 1.5, atol=1e-10)


@pytest.mark.parametrize("flag", [1.4, 0.9])
def test_of_a_crossing_and_a_flag_within_a_step(flag):
    """A flag is an event at the end of a step, and was taken for the first where it is first in the list."""
    conditions = [lambda t, y, a, **_: t > flag, lambda t, y, a, **_: t - 1.2]
    sol = thrown(diffrax.Event(conditions, optimistix.Newton(1e-10, 1e-10)), diffrax.Tsit5(), 0.0, 2.0)
    time = float(sol.ts[-1])
    assert [bool(x) for x in sol.event_mask] == [flag < 1.2, flag > 1.2]
    assert flag < time < 1.2 if flag < 1.2 else abs(time - 1.2) < 1e-10


@pytest.mark.parametrize(
    "adjoint", [diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode()], ids=["reverse", "forward"]
)
def test_the_time_at_which_a_solve_ends_has_its_derivative(adjoint):
    derivative = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.grad
    event = diffrax.Event(lambda t, y, a, **_: y[0][1], optimistix.Newton(1e-10, 1e-10))

    def fallen(height, t1, event):
        start = (jnp.array([0.0, 1.0]) * height, jnp.zeros(2))
        return dae_jax.daesolve(BALL, diffrax.Tsit5(), 0.0, t1, None, start, event=event, adjoint=adjoint).stats[
            "end_time"
        ]

    np.testing.assert_allclose(
        derivative(lambda h: fallen(h, 10.0, event))(1.3), 1 / np.sqrt(2 * GRAVITY * 1.3), rtol=1e-7
    )
    np.testing.assert_allclose(derivative(lambda t1: fallen(1.3, t1, None))(0.4), 1.0, rtol=1e-12)


def test_bisection_of_several_conditions_is_refused():
    conditions = [lambda t, y, args, **kwargs: y[0] - 0.5, lambda t, y, args, **kwargs: t - 2.0]
    event = diffrax.Event(conditions, optimistix.Bisection(1e-9, 1e-9, flip="detect"))
    decay = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd + y)
    with pytest.raises(ValueError, match="finds the first of several events by"):
        dae_jax.daesolve(decay, dae_jax.RadauIIA5(), 0.0, 3.0, None, jnp.ones(1), event=event)


# cos 7t is given, its derivative or what it is the derivative of is found.
GIVEN = {
    "given": (lambda t, y, yd, a: [yd[1] - y[0], y[1] - jnp.cos(7 * t)], jnp.array([0.0, 1.0])),
    "found": (lambda t, y, yd, a: [yd[0] + 7 * y[1], y[0] + jnp.sin(7 * t)], jnp.array([0.0, 1.0])),
}
RESIDUAL_SOLVERS = (dae_jax.BDF, dae_jax.RadauIIA5, dae_jax.RadauIIA9, dae_jax.RadauIIA13, dae_jax.Radau)


@pytest.mark.parametrize("direction", [None, True, False])
@pytest.mark.parametrize("name", GIVEN)
@pytest.mark.parametrize("solver", RESIDUAL_SOLVERS)
def test_one_crossing_is_one_reset(solver, name, direction):
    """The state after a reset is off by the tolerance, and may be on the side that it came from."""
    equations, start = GIVEN[name]
    t = np.pi / 21 * np.array([1, 5, 7, 11, 13, 17, 19])
    exact = {None: t, True: t[1::2], False: t[::2]}[direction]
    event = dae_jax.Reset(lambda t, y, a, **k: y[1] - 0.5, lambda t, y, a: (y, a), direction)
    for tolerance in (1e-3, 1e-4, 1e-6, 1e-8):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        options = {"stepsize_controller": controller, "event": event, "max_steps": 100_000}
        sol = dae_jax.daesolve(dae_jax.ImplicitDAE(equations), solver(), 0.0, 3.0, None, start, **options)
        assert sol.stats["jumps"] == len(exact)
        assert np.abs(sol.stats["jump_times"][: len(exact)] - exact).max() < 10 * tolerance


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF(), diffrax.Tsit5()], ids=["radau", "bdf", "tsit"])
def test_resets_know_no_unit_of_length(solver, length):
    """A ball that falls by its length in 1 s, three times, and is held then for long; z, which says when it lands, is algebraic."""

    def falling(t, y, yd, left):
        h, v, z = y / length
        return jnp.stack([yd[0] / length - v, yd[1] / length + jnp.where(left > 0, 2.0, 0.0), z + z**3 - h])

    def bounce(t, y, left):
        return jnp.where(left > 1, y.at[1].multiply(-1.0), start), left - 1

    start = length * jnp.array([1.0, 0.0, 0.6823278038280193])
    event = dae_jax.Reset(lambda t, y, left, **_: y[2], bounce, direction=False)
    controller = diffrax.PIDController(rtol=1e-4, atol=1e-4 * length)
    options = {"stepsize_controller": controller, "event": event}
    sol = dae_jax.daesolve(dae_jax.ImplicitDAE(falling), solver, 0.0, 4000.0, None, start, 3.0, **options)
    assert sol.stats["jumps"] == 3
    np.testing.assert_allclose(sol.stats["jump_times"][:3], [1.0, 3.0, 5.0], rtol=3e-4)
    np.testing.assert_allclose(sol.final[0], length, rtol=1e-6)


def test_resets_of_a_large_system_know_no_unit_of_time():
    """sin ωt falls through zero three times in ten turns of a nanosecond: its rate after a reset is not that of √ε s."""
    omega, many = 0.7e9, LARGE
    residual = lambda t, y, yd, args: jnp.append(yd[:-1] / omega + y[:-1], y[-1] - jnp.sin(omega * t))
    event = dae_jax.Reset(lambda t, y, n, **_: y[-1], lambda t, y, n: (y, n + 1.0), direction=False)
    start = jnp.append(jnp.ones(many), 0.0)
    sol = dae_jax.daesolve(
        dae_jax.ImplicitDAE(residual), dae_jax.RadauIIA5(), 0.0, 20 / omega, None, start, 0.0, event=event
    )
    assert sol.stats["jumps"] == 3
    np.testing.assert_allclose(omega * sol.stats["jump_times"][:3], np.pi * np.array([1, 3, 5]), rtol=1e-6)


@pytest.mark.parametrize("solver", [dae_jax.OrthogonalProjection(dae_jax.DOP853()), dae_jax.RadauIIA5()])
@pytest.mark.parametrize("direction", [None, True])
def test_a_reset_after_which_the_consistent_state_is_far_beyond_the_stop(solver, direction):
    """A rod on which nothing acts turns at speed 1, is sent back at x = 1/2, and is longer from there on, so that x = 0.55: it crosses
    the stop on its way back, at φ = asin(1/2.2), where crossings both ways count.
    """
    rod = dae_jax.ConstrainedSystem(lambda t, q, v, r: jnp.zeros(2), lambda t, q, r: (q @ q - r**2) / 2)
    longer = dae_jax.Reset(
        lambda t, y, r, **_: y[0][0] - 0.5,
        lambda t, y, r: ((y[0], -y[1]), jnp.where(r < 1.05, 1.1, r)),
        direction,
    )
    start = (jnp.array([0.0, -1.0]), jnp.array([1.0, 0.0]))
    sol = dae_jax.daesolve(rod, solver, 0.0, 0.8, None, start, 1.0, event=longer, throw=False)
    hit, again = np.pi / 6, np.pi / 6 + 1.1 * (np.pi / 6 - np.arcsin(1 / 2.2))
    times = [hit] if direction else [hit, again]
    assert sol.stats["jumps"] == len(times)
    np.testing.assert_allclose(sol.stats["jump_times"][: len(times)], times, atol=1e-7)
    back = np.abs(0.8 - again) if not direction else again - 0.8
    angle = np.arcsin(1 / 2.2) + back / 1.1
    np.testing.assert_allclose(sol.ys[0][-1], 1.1 * np.array([np.sin(angle), -np.cos(angle)]), atol=1e-7)


@pytest.mark.parametrize("solver", [dae_jax.RadauIIA5(), dae_jax.BDF()])
def test_a_reset_that_goes_a_hundred_tolerances_beyond_the_stop(solver):
    """A rod that turns at speed 1 is sent back at x = 1/2, from 0.01 rad beyond: it has not reached the stop from below again."""
    turn = jnp.array([[jnp.cos(0.01), -jnp.sin(0.01)], [jnp.sin(0.01), jnp.cos(0.01)]])
    rod = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.zeros(2), lambda t, q, args: (q @ q - 1) / 2)
    back = dae_jax.Reset(lambda t, y, a, **_: y[0][0] - 0.5, lambda t, y, a: ((turn @ y[0], -turn @ y[1]), a), True)
    start = (jnp.array([0.0, -1.0]), jnp.array([1.0, 0.0]))
    sol = dae_jax.daesolve(
        rod, solver, 0.0, 2.0, None, start, event=back, stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-4)
    )
    assert sol.stats["jumps"] == 1
    angle = np.pi / 3 + 0.01 - 2.0
    np.testing.assert_allclose(sol.ys[0][-1], [np.sin(angle), -np.cos(angle)], atol=0.02)
