"""NaN in, error out: every number that a solve takes, where it is traced and cannot be looked at before."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax


ROD = dae_jax.ConstrainedSystem(lambda t, q, v, g: jnp.stack([0 * g, -g]), lambda t, q, args: (q @ q - 1) / 2)
START = (jnp.array([1.0, 0.0]), jnp.zeros(2))
SOLVERS = {
    "projection": dae_jax.OrthogonalProjection(diffrax.Tsit5()),
    "RadauIIA5": dae_jax.RadauIIA5(),
    "BDF": dae_jax.BDF(),
    "dummy derivatives": diffrax.Tsit5(),
}
PID = diffrax.PIDController


def ended(by, t0=0.0, t1=0.5, dt0=None, y0=START, gravity=9.81, **options):
    form = dae_jax.DummyDerivatives() if by == "dummy derivatives" else None
    return dae_jax.daesolve(
        ROD, SOLVERS[by], t0, t1, dt0, y0, gravity, formulation=form, throw=False, max_steps=200, **options
    )


PLACES = {
    "t0": lambda by, x: ended(by, t0=x),
    "t1": lambda by, x: ended(by, t1=0.5 + x),
    "t1 and fixed steps": lambda by, x: ended(by, t1=0.5 + x, dt0=0.05),
    "dt0": lambda by, x: ended(by, dt0=0.05 + x),
    "the first of steps that are chosen": lambda by, x: ended(by, dt0=0.05 + x, stepsize_controller=PID(1e-6, 1e-6)),
    "y0": lambda by, x: ended(by, y0=(START[0] + x, START[1])),
    "args": lambda by, x: ended(by, gravity=9.81 + x),
    "rtol": lambda by, x: ended(by, stepsize_controller=PID(1e-6 + x, 1e-6)),
    "atol": lambda by, x: ended(by, stepsize_controller=PID(1e-6, 1e-6 + x)),
    "ts": lambda by, x: ended(by, saveat=diffrax.SaveAt(ts=jnp.stack([0.1 + x, 0.5 + 0 * x]))),
    "the last of ts": lambda by, x: ended(by, saveat=diffrax.SaveAt(ts=jnp.stack([0.1 + 0 * x, 0.5 + x]))),
    "ts with a reset": lambda by, x: ended(
        by,
        saveat=diffrax.SaveAt(ts=jnp.stack([0.1 + x, 0.5 + 0 * x])),
        event=dae_jax.Reset(lambda t, y, args, **k: y[0][0] + 2, lambda t, y, args: (y, args)),
    ),
    "t1 with a reset": lambda by, x: ended(
        by, t1=0.5 + x, event=dae_jax.Reset(lambda t, y, args, **k: y[0][0] + 2, lambda t, y, args: (y, args))
    ),
}


# Dummy derivatives by an explicit solver locate no events.
CASES = [(by, place) for by in SOLVERS for place in PLACES if not ("reset" in place and by == "dummy derivatives")]


@pytest.mark.parametrize(("by", "place"), CASES)
def test_a_solve_fails(by, place):
    solve = jax.jit(lambda x: PLACES[place](by, x).result)
    assert solve(0.0) == dae_jax.RESULTS.successful
    assert solve(jnp.nan) not in (dae_jax.RESULTS.successful, dae_jax.RESULTS.event_occurred)


@pytest.mark.parametrize("place", ["t0", "t1"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_interval_that_is_none_is_said_so(place, value):
    assert jax.jit(lambda x: PLACES[place]("projection", x).result)(value) == dae_jax.RESULTS.undefined_interval


def test_one_lane_of_a_batch():
    """The others are as they are alone, and nothing is known at times that are NaN."""
    ts = jnp.array([[0.1, 0.3, 0.5], [0.1, jnp.nan, 0.5]])
    sol = jax.vmap(lambda ts: ended("projection", saveat=diffrax.SaveAt(ts=ts)))(ts)
    codes = [dae_jax.RESULTS.successful, dae_jax.RESULTS.times_outside]
    assert sol.result._value.tolist() == [int(code._value) for code in codes]
    np.testing.assert_array_equal(np.isfinite(sol.ys[0][..., 0]), [[True] * 3, [True, False, False]])
