"""Resets whose condition is zero, and at rest there: at the start, and after a reset."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


RESULTS = dae_jax.RESULTS
AT_ZERO = (jnp.zeros(2), jnp.zeros(2))
SOLVERS = {
    "projection": dae_jax.OrthogonalProjection(dae_jax.DOP853()),
    "radau": dae_jax.RadauIIA5(),
    "bdf": dae_jax.BDF(),
}


def pushed(acceleration, direction, t1):
    """A mass on a wire at x = 0, at rest, with `acceleration`(t), turned round where its height crosses zero."""
    wire = dae_jax.ConstrainedSystem(
        lambda t, q, v, sign: jnp.stack([0 * t, sign * acceleration(t)]), lambda t, q, sign: q[0]
    )
    turn = dae_jax.Reset(lambda t, y, sign, **_: y[0][1], lambda t, y, sign: ((y[0], -y[1]), -sign), direction)
    return lambda solver, sign: dae_jax.daesolve(
        wire, solver, 0.0, t1, None, AT_ZERO, sign, event=turn, throw=False
    )  # fmt: skip


@pytest.mark.parametrize("direction", [None, True, False])
@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_condition_that_leaves_zero_from_rest(name, order, direction):
    """h = ± tⁿ (t − 1) crosses zero at t = 1, where it is turned round: the n-th derivative says on which side it was."""
    n = order
    solve = pushed(lambda t: (n + 1) * n * t ** (n - 1) - n * (n - 1) * t ** (n - 2), direction, 1.2)
    for sign in (1.0, -1.0):
        sol = solve(SOLVERS[name], sign)
        counts = direction is None or direction == (sign > 0)
        assert sol.result == RESULTS.successful
        assert sol.stats["jumps"] == counts
        height = sign * 1.2**n * 0.2 * (-1 if counts else 1)
        np.testing.assert_allclose(sol.ys[0][-1, 1], height, atol=1e-6)


@pytest.mark.parametrize("direction", [None, True, False])
def test_a_condition_that_is_zero_for_a_while(direction):
    """Which crossings count is to be said where no derivative tells the side: h is (t − 1)² (t − 1.5) from t = 1 on."""
    solver = SOLVERS["projection"]
    solve = lambda t1: pushed(lambda t: jnp.where(t > 1, 6 * (t - 1) - 1, 0.0), direction, t1)(solver, 1.0)
    assert solve(0.9).result == RESULTS.successful
    found = solve(1.7)
    assert found.result == (RESULTS.undetermined_side if direction is None else RESULTS.successful)
    assert found.stats["jumps"] == (direction is True)


@pytest.mark.parametrize("direction", [None, False])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_ball_that_a_reset_brings_to_rest_does_not_fall_through(name, direction):
    """Whatever round-off has left of the height at which it lands."""
    wire = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.array([0.0, -9.81]), lambda t, q, args: q[0])
    stop = dae_jax.Reset(lambda t, y, args, **_: y[0][1], lambda t, y, args: ((y[0], 0 * y[1]), args), direction)
    for height in (1.0, 0.7, 1.3, 0.1234):
        start = (jnp.array([0.0, height]), jnp.zeros(2))
        sol = dae_jax.daesolve(wire, SOLVERS[name], 0.0, 1.0, None, start, event=stop, throw=False)
        assert sol.result == RESULTS.too_many_jumps


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), dae_jax.RadauIIA5()], ids=["tsit", "radau"])
def test_from_rest_backwards(solver):
    """h = (3 − t)² (2 − t) from t = 3 to 1.8, upwards beyond t = 2."""
    wire = dae_jax.ConstrainedSystem(lambda t, q, v, args: jnp.stack([0 * t, 6 * (3 - t) - 2]), lambda t, q, a: q[0])
    turn = dae_jax.Reset(lambda t, y, a, **_: y[0][1], lambda t, y, a: (y, a))
    sol = dae_jax.daesolve(wire, solver, 3.0, 1.8, None, AT_ZERO, event=turn)
    assert sol.stats["jumps"] == 1
    np.testing.assert_allclose(sol.stats["jump_times"][0], 2.0, atol=1e-8)


@pytest.mark.parametrize("direction", [None, False])
def test_what_a_reset_lets_go_falls(direction):
    """It is held at zero until t = 1.5: the reset has not brought it to rest."""
    wire = dae_jax.ConstrainedSystem(lambda t, q, v, held: jnp.stack([0 * t, (held - 1) * 9.81]), lambda t, q, a: q[0])
    condition = lambda t, y, held, **_: jnp.where(held > 0, 1.5 - t, y[0][1])
    let_go = dae_jax.Reset(condition, lambda t, y, held: (y, 0.0 * held), direction)
    sol = dae_jax.daesolve(wire, SOLVERS["projection"], 0.0, 2.0, None, AT_ZERO, 1.0, event=let_go)
    assert sol.stats["jumps"] == 1
    np.testing.assert_allclose(sol.ys[0][-1, 1], -9.81 / 8, atol=1e-8)
