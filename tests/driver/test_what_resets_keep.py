"""What a reset sets is kept where the rest can be made consistent with it: a multiplier or a current that it does not mention gives way."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import dae_jax


SOLVERS = {"radau": dae_jax.RadauIIA5(), "bdf": dae_jax.BDF()}
# x′ = −z, z = x: half of x is gone after ln 2.
DECAY = dae_jax.SemiExplicitDAE(lambda t, x, z, a: -z, lambda t, x, z, a: z - x)
FULL = (jnp.ones(1), jnp.ones(1))
REFILLED = dae_jax.Reset(lambda t, y, a, **kwargs: y[0][0] - 0.5, lambda t, y, a: ((jnp.array([a]), y[1]), a), False)


@pytest.mark.parametrize("solver", [*SOLVERS, "tsit5"])
def test_an_algebraic_variable_follows(solver):
    by = SOLVERS.get(solver, diffrax.Tsit5())
    end = lambda a: dae_jax.daesolve(DECAY, by, 0.0, 1.0, None, FULL, a, event=REFILLED).ys[0][0, 0]
    left = np.exp(-(1 - np.log(2)))
    value, slope = jax.jvp(end, (0.9,), (1.0,))
    np.testing.assert_allclose([value, slope], [0.9 * left, left], rtol=1e-6)


def pendulum(t, y, yd, rebound):
    x, v, multiplier = y[:2], y[2:4], y[4]
    accelerations = yd[2:4] + multiplier * x + jnp.array([0.0, 9.81])
    return jnp.concatenate([yd[:2] - v, accelerations, (x @ x - 1)[None] / 2])


SWUNG = jnp.array([np.sin(1.0), -np.cos(1.0), 0, 0, 9.81 * np.cos(1.0)])
RODS = dae_jax.ConstrainedSystem(
    lambda t, q, v, rebound: jnp.array([0.0, -9.81]), lambda t, q, rebound: (q @ q - 1)[None] / 2
)


@pytest.mark.parametrize("multiplier", [0.0, None])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_bounce_of_equations_as_written_is_that_of_the_mechanism(solver, multiplier):
    """The multiplier as it was, or set to 0, was half of the way to a consistent state, and velocities the other half."""

    def bounced(t, y, rebound):
        y = y.at[2:4].multiply(-rebound)
        return (y if multiplier is None else y.at[4].set(multiplier)), rebound

    wall = dae_jax.Reset(lambda t, y, rebound, **kwargs: y[0] + 0.3, bounced, False)
    same = dae_jax.Reset(
        lambda t, y, rebound, **kwargs: y[0][0] + 0.3, lambda t, y, rebound: ((y[0], -rebound * y[1]), rebound), False
    )
    found = dae_jax.daesolve(dae_jax.ImplicitDAE(pendulum), SOLVERS[solver], 0.0, 1.2, None, SWUNG, 0.5, event=wall)
    mechanism = dae_jax.daesolve(
        RODS, dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, 1.2, None, (SWUNG[:2], SWUNG[2:4]), 0.5, event=same
    )
    assert found.stats["jumps"] == mechanism.stats["jumps"] == 1
    np.testing.assert_allclose(found.ys[0, :4], np.concatenate([x[0] for x in mechanism.ys]), rtol=3e-6, atol=3e-6)


def test_what_cannot_be_kept_is_as_near_as_can_be():
    """Set off the circle, to (2, 0) with a speed that points away from it."""
    off = lambda t, y, rebound: (jnp.array([2.0, 0.0, 1.0, 3.0, 0.0]), rebound)
    event = dae_jax.Reset(lambda t, y, rebound, **kwargs: y[0] + 0.3, off, False)
    sol = dae_jax.daesolve(
        dae_jax.ImplicitDAE(pendulum), dae_jax.RadauIIA5(), 0.0, 0.9, None, SWUNG, 0.5, event=event,
        saveat=diffrax.SaveAt(ts=jnp.array([0.0, 0.9])),
    )  # fmt: skip
    at = float(sol.stats["jump_times"][0])
    assert 0 < at < 0.9

    def way(angle):
        """To the state at an angle and the best speed there, and its energy."""
        c, s = np.cos(angle), np.sin(angle)
        speed = 3 * c - s
        return (c - 2) ** 2 + s**2 + (-speed * s - 1) ** 2 + (speed * c - 3) ** 2, speed**2 / 2 + 9.81 * s

    nearest = scipy.optimize.minimize_scalar(
        lambda angle: way(angle)[0], bounds=(-1, 1), method="bounded", options={"xatol": 1e-9}
    ).x
    x, y, *speeds, _ = sol.ys[1]
    assert x**2 + y**2 == pytest.approx(1, abs=1e-9)
    assert (speeds[0] ** 2 + speeds[1] ** 2) / 2 + 9.81 * y == pytest.approx(way(nearest)[1], rel=1e-6)


def test_of_two_states_the_nearer_in_what_is_kept_is_taken():
    """From (0, 0) to 3 x + y = 10: (3, 1) is nearest; (2.5, 2.5), where z = 10 (x − y) is as it was, is less off in x alone."""
    a = jnp.array([3.0, 1.0])
    system = dae_jax.SemiExplicitDAE(
        lambda t, x, z, args: -a * z[0], lambda t, x, z, args: jnp.stack([a @ x - 10, z[1] - 10 * (x[0] - x[1])])
    )
    event = dae_jax.Reset(lambda t, y, args, **kwargs: t - 0.5, lambda t, y, args: ((jnp.zeros(2), jnp.zeros(2)), args))
    start = (jnp.array([3.0, 1.0]), jnp.array([0.0, 20.0]))
    found = dae_jax.daesolve(system, dae_jax.RadauIIA5(), 0.0, 1.0, None, start, event=event).ys[0][0]
    np.testing.assert_allclose(found, [3, 1], rtol=1e-7)
