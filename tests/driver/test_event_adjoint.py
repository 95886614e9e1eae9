"""Reverse derivatives of solves that an event ends, against the closed form of a fall along a wall."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dae_jax
from dae_jax.driver.event_adjoint import stopped, up_to
from dae_jax.driver.followed_steps import Steps, Stop, as_bits, of_bits
from dae_jax.driver.program import Solve


# q = (0, h + v (t − t₀) − g (t − t₀)²/2), until the moving floor c t is reached.
FALL = dae_jax.ConstrainedSystem(lambda t, q, v, p: jnp.stack([0 * p["g"], -p["g"]]), lambda t, q, p: q[0])
AS_RESIDUAL = dae_jax.ImplicitDAE(lambda t, y, yd, p: jnp.stack([yd[0] - y[1], yd[1] + p["g"], y[2] - y[0] * y[1]]))
P = {"h": jnp.asarray(1.0), "v": jnp.asarray(0.7), "g": jnp.asarray(2.0), "c": jnp.asarray(-0.1)}
TOLERANCE = 1e-9
FINDER = optimistix.Bisection(1e-13, 1e-13, flip="detect")
METHODS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
    "explicit": (diffrax.Tsit5(), None),
    "Radau": (dae_jax.RadauIIA5(), None),
    "BDF": (dae_jax.BDF(), None),
    "residual by Radau": (dae_jax.RadauIIA5(), None),
}


def landing(p, t0):
    """The time from the start on."""
    speed, height = p["v"] - p["c"], p["h"] - p["c"] * t0
    return (speed + jnp.sqrt(speed**2 + 2 * p["g"] * height)) / p["g"]


def place(p, t):
    return p["h"] + p["v"] * t - p["g"] * t**2 / 2


def exact(p, times, t0, t1):
    """Heights at the times that were reached, the end's time, height and speed."""
    end = jnp.minimum(landing(p, t0), t1 - t0)
    heights = jnp.where(times <= t0 + end, place(p, times - t0), 0)
    return jnp.concatenate([heights, jnp.stack([t0 + end, place(p, end), p["v"] - p["g"] * end])])


def solved(p, times, t0, t1, name):
    solver, formulation = METHODS[name]
    height = (lambda y: y[0]) if name == "residual by Radau" else (lambda y: y[0][1])
    speed = (lambda y: y[1]) if name == "residual by Radau" else (lambda y: y[1][1])
    event = diffrax.Event(lambda t, y, p, **_: height(y) - p["c"] * t, FINDER)
    y0 = (jnp.stack([0 * p["h"], p["h"]]), jnp.stack([0 * p["v"], p["v"]]))
    system, start = FALL, y0
    if name == "residual by Radau":
        system, start = AS_RESIDUAL, jnp.stack([p["h"], p["v"], p["h"] * p["v"]])
    sol = dae_jax.daesolve(
        system, solver, t0, t1, None, start, p, formulation=formulation, event=event, max_steps=400,
        saveat=diffrax.SaveAt(ts=times, t1=True),
        stepsize_controller=diffrax.PIDController(TOLERANCE, TOLERANCE),
    )  # fmt: skip
    row = jnp.sum(jnp.isfinite(sol.ts)) - 1
    heights = jax.vmap(height)(sol.ys)
    saved = jnp.where(jnp.arange(len(times)) < row, heights[:-1], 0)
    return jnp.concatenate([saved, jnp.stack([sol.ts[row], heights[row], jax.vmap(speed)(sol.ys)[row]])])


TIMES = jnp.array([0.2, 0.9, 1.3, 1.8])


@pytest.mark.parametrize("name", METHODS)
def test_are_those_of_the_closed_form(name):
    """By all parameters, the saved times, the start and the end; of these the landing is at 1.48, between the last two times."""
    found = jax.jit(jax.jacrev(lambda *x: solved(*x, name), (0, 1, 2, 3)))(P, TIMES, 0.0, 2.0)
    expected = jax.jacrev(exact, (0, 1, 2, 3))(P, TIMES, 0.0, 2.0)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=200 * TOLERANCE)


def test_lanes_with_and_without_an_event():
    heights = jnp.array([0.3, 1.0, 8.0])
    of = lambda h, fn: jax.vmap(lambda h: fn({**P, "h": h}))(h)
    loss = lambda fn: lambda h: jnp.sum(of(h, fn) ** 2)
    found = jax.jit(jax.grad(loss(lambda p: solved(p, TIMES, 0.0, 2.0, "projection"))))(heights)
    expected = jax.grad(loss(lambda p: exact(p, TIMES, 0.0, 2.0)))(heights)
    np.testing.assert_allclose(found, expected, rtol=200 * TOLERANCE)


@pytest.mark.parametrize("name", ["projection", "residual by Radau"])
def test_second_derivatives(name):
    of = lambda fn: lambda x: fn({**P, "h": x[0], "g": x[1], "c": x[2]}, TIMES, 0.0, 2.0)
    x = jnp.stack([P["h"], P["g"], P["c"]])
    found = jax.jit(jax.jacfwd(jax.jacrev(of(lambda *a: solved(*a, name)))))(x)
    np.testing.assert_allclose(found, jax.hessian(of(exact))(x), atol=1e4 * TOLERANCE)


def test_backwards():
    back = lambda p: dae_jax.daesolve(
        FALL, METHODS["projection"][0], 1.0, -1.0, None,
        (jnp.stack([0 * p["h"], p["h"]]), jnp.stack([0 * p["h"], p["v"]])), p,
        event=diffrax.Event(lambda t, y, p, **_: y[0][1] + 1.0, FINDER),
        stepsize_controller=diffrax.PIDController(TOLERANCE, TOLERANCE),
    )  # fmt: skip
    time = lambda p: back(p).ts[-1]
    found = jax.jit(jax.grad(time))(P)
    when = lambda p: 1.0 - (-p["v"] + jnp.sqrt(p["v"] ** 2 + 2 * p["g"] * (p["h"] + 1))) / p["g"]
    assert time(P) == pytest.approx(float(when(P)), abs=1e-8)
    for name, value in jax.grad(when)(P).items():
        np.testing.assert_allclose(found[name], value, atol=200 * TOLERANCE)


FLAGS = {
    "flag": diffrax.Event(lambda t, y, p, **_: y[0][1] < 0.5),
    "not looked for": diffrax.Event(lambda t, y, p, **_: y[0][1] - 0.5),
}


@pytest.mark.parametrize("kind", FLAGS)
def test_at_the_end_of_a_step(kind):
    """Whose time has no derivative."""

    def flagged(p):
        sol = dae_jax.daesolve(
            FALL, METHODS["projection"][0], 0.0, 2.0, 0.1,
            (jnp.stack([0 * p["h"], p["h"]]), jnp.stack([0 * p["h"], p["v"]])), p,
            event=FLAGS[kind], max_steps=100,
            stepsize_controller=diffrax.PIDController(TOLERANCE, TOLERANCE),
        )  # fmt: skip
        return sol.ts[-1], sol.ys[0][-1, 1]

    (of_time, of_height), (end, _) = jax.jit(jax.jacrev(flagged))(P), flagged(P)
    np.testing.assert_array_equal(jax.tree.leaves(of_time), 0)
    np.testing.assert_allclose([of_height[k] for k in "hvg"], [1, end, -(end**2) / 2], atol=200 * TOLERANCE)


def test_steps_of_a_derivative_end_where_the_solution_does():
    """An event is earlier or later by them than by those of the solution, as far as its error goes; by another event they are lost."""
    times = jnp.array([0.0, 0.5, 0.9, 1.4, jnp.inf, jnp.inf])
    at = lambda end, event=0: of_bits(
        stopped(as_bits(Steps(times, None)), Stop(jnp.asarray(end), jnp.asarray(event)), False)
    )
    ends = lambda end: up_to(as_bits(at(end)), jnp.asarray(end)).times
    for end, expected in ((1.2, [0, 0.5, 0.9, 1.2]), (0.89, [0, 0.5, 0.89]), (1.41, [0, 0.5, 0.9, 1.41])):
        found = ends(end)
        np.testing.assert_array_equal(found[jnp.isfinite(found)], expected)
    assert np.isnan(ends(2.0)).any()
    # Of a solve that failed what was saved before has its derivative.
    assert not np.isnan(at(2.0, event=-1).times).any()


def test_the_trajectory_serves_events_but_not_every_one():
    """Of large forms the end does not move as the equations say."""
    from dae_jax.driver.trajectory_adjoint import has_trajectory_adjoint

    event = diffrax.Event(lambda t, y, args, **_: y[0], FINDER)
    solve = lambda formulation, solver: Solve(
        formulation, solver, diffrax.SaveAt(subs=diffrax.SubSaveAt(t1=True)), diffrax.PIDController(1e-6, 1e-6),
        diffrax.RecursiveCheckpointAdjoint(), event, diffrax.NoProgressMeter(), 100,
    )  # fmt: skip
    field, residual = dae_jax.Differentiation(), dae_jax.Residual("GGL")
    assert has_trajectory_adjoint(solve(field, diffrax.Tsit5()), 100)
    assert has_trajectory_adjoint(solve(residual, dae_jax.RadauIIA5()), 30)
    assert not has_trajectory_adjoint(solve(residual, dae_jax.RadauIIA5()), 100)
