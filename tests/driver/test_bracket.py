"""Where events are: in any unit, at any time, and in batches in which some lanes have none."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax


GROWTH = dae_jax.ImplicitDAE(lambda t, y, yd, k: yd - k * y)
AT_TWO = diffrax.Event(lambda t, y, k, **_: y[0] - 2.0, optimistix.Bisection(1e-10, 1e-10, flip="detect"))


def bounces(metre, second, t0, direction, solver, speed=0.0):
    """A ball that falls for 2 s from a height of 1 m, where a metre and a second are so many units: its height in m at the end, and how
    often it bounced.
    """
    g = 9.81 * metre / second**2
    ball = dae_jax.ImplicitDAE(
        lambda t, y, yd, a: jnp.stack([(yd[0] - y[1]) * second, (yd[1] + g) * second**2]) / metre
    )
    reset = dae_jax.Reset(
        lambda t, y, a, **_: y[0], lambda t, y, a: (y * jnp.array([1.0, -0.7]), a), direction=direction
    )
    start = jnp.array([metre, speed * metre / second])
    control = diffrax.PIDController(rtol=1e-8, atol=jnp.array([1e-8 * metre, 1e-8 * metre / second]))
    sol = dae_jax.daesolve(
        ball, solver, t0, t0 + 2.0 * second, None, start, event=reset, stepsize_controller=control, throw=False
    )  # fmt: skip
    assert sol.result == dae_jax.RESULTS.successful
    return float(sol.ys[-1, 0] / metre), int(sol.stats["jumps"])


def exact(speed=0.0):
    g, left, height, count = 9.81, 2.0, 1.0, 0
    while True:
        falls = (speed + np.sqrt(speed**2 + 2 * g * height)) / g
        if falls >= left:
            return height + speed * left - g * left**2 / 2, count
        left, height, speed, count = left - falls, 0.0, 0.7 * (g * falls - speed), count + 1


@pytest.mark.parametrize("direction", [False, None])
@pytest.mark.parametrize(
    ("metre", "second", "t0"),
    [(1, 1, 0), (1e6, 1, 0), (1e-10, 1, 0), (1, 1e-9, 0), (1, 1e9, 0), (1e6, 1e6, 1e6), (1, 1, 1e6), (1, 1, -1.0)],
)
def test_a_ball_bounces_alike_in_all_units(metre, second, t0, direction):
    height, count = bounces(metre, second, t0, direction, dae_jax.DOP853())
    assert count == exact()[1]
    assert abs(height - exact()[0]) < 1e-6 + 1e-8 * abs(t0) / second


@pytest.mark.parametrize("metre", [1e-10, 1.0, 1e6])
@pytest.mark.parametrize("speed", [-3.0, 3.0])
def test_a_start_near_zero_in_its_unit_is_none_at_zero(metre, speed):
    height, count = bounces(metre, 1.0, 0.0, None, dae_jax.RadauIIA5(), speed)
    assert count == exact(speed)[1]
    assert abs(height - exact(speed)[0]) < 1e-6


@pytest.mark.parametrize("solver", [dae_jax.DOP853(), dae_jax.RadauIIA5()], ids=["dop853", "radau"])
def test_lanes_without_an_event_go_on(solver):
    def end(k):
        sol = dae_jax.daesolve(GROWTH, solver, 0.0, 2.0, None, jnp.ones(1), k, event=AT_TWO, throw=False)
        return sol.ys[-1, 0], sol.stats["end_time"]

    for batch in (jax.vmap(end), jax.jit(jax.vmap(end))):
        y, t = batch(jnp.array([1.0, -1.0, 0.5]))
        np.testing.assert_allclose(y, [2.0, np.exp(-2), 2.0], rtol=1e-6)
        np.testing.assert_allclose(t, [np.log(2), 2.0, 2 * np.log(2)], rtol=1e-6)


def test_a_finder_that_is_finer_than_numbers_ends():
    """At t = 1e6 the condition changes by more than its tolerance from one number to the next."""
    event = diffrax.Event(lambda t, y, k, **_: y[0] - 2.0, optimistix.Bisection(1e-12, 1e-12, flip="detect"))
    sol = dae_jax.daesolve(GROWTH, dae_jax.DOP853(), 1e6, 1e6 + 2, None, jnp.ones(1), 1.0, event=event)
    assert abs(sol.ts[-1] - 1e6 - np.log(2)) < 1e-8


def test_no_zero_is_a_result_and_no_error():
    event = diffrax.Event(lambda t, y, k, **_: jnp.sqrt(y[0] - 2.0), optimistix.Bisection(1e-10, 1e-10, flip="detect"))
    sol = dae_jax.daesolve(GROWTH, dae_jax.DOP853(), 0.0, 2.0, None, jnp.ones(1), 1.0, event=event, throw=False)
    assert sol.result != dae_jax.RESULTS.successful
