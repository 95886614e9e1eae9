"""Starts and drift where some unknowns are large: what is a part of these is all of the others."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dae_jax
from dae_jax import AccuracyWarning, ConstrainedSystem, ImplicitDAE, OrthogonalProjection


ORBIT, TURN = 6.8e6, 1.2e-3


def unit_vector(force=lambda t, q, v, args: jnp.zeros(3), orbit=ORBIT):
    """A coordinate far away, and a unit vector beside it."""
    start = jnp.array([orbit, 1.0, 0.0]), jnp.array([7.6e3, 0.0, TURN])
    return ConstrainedSystem(force, lambda t, q, args: (q[1:] @ q[1:] - 1) / 2), start


def circuit(t, y, yd, args):
    """A conductance, and a count of 1e7 beside it, which occurs in another equation."""
    u, i, count = y
    return jnp.stack([yd[0] + u, i - u, yd[2] + count])


def sliding(t, y, yd, args):
    """Index 2: x − w = 0, and its derivative v − ẇ = 0 with ẇ = w, beside a count of 1e7."""
    x, v, w, count, force = y
    return jnp.stack([yd[0] - v, yd[1] - force, yd[2] - w, yd[3] + count, x - w])


@pytest.mark.parametrize("level", [0, 1])
def test_a_part_of_the_orbit_is_no_round_off_of_a_unit_vector(level):
    system, start = unit_vector()
    off = jnp.array([0.0, 0.05, 0.0]) if level == 0 else jnp.array([0.0, 1e-4, 0.0])
    start = tuple(x + off if k == level else x for k, x in enumerate(start))
    solve = lambda start, **options: dae_jax.daesolve(
        system, OrthogonalProjection(dae_jax.DOP853()), 0.0, 100.0, None, start, **options
    )
    with pytest.raises(ValueError, match=["position level", "velocity level"][level]):
        solve(start)
    solve(dae_jax.consistent_state(system, 0.0, start))
    code = jax.jit(lambda start: solve(start, throw=False).result._value)(start)
    assert int(code) == int(dae_jax.RESULTS.inconsistent_start._value)


@pytest.mark.parametrize(
    ("residual", "start", "wrong"),
    [(circuit, [1.0, 1.0, 1e7], 1), (sliding, [1.0, 1.0, 1.0, 1e7, 1.0], 0), (sliding, [1.0, 1.0, 1.0, 1e7, 1.0], 1)],
    ids=["index 1", "index 3", "hidden"],
)
def test_a_part_of_a_count_is_no_round_off_of_a_current(residual, start, wrong):
    system, y0 = ImplicitDAE(residual), jnp.array(start)
    solve = lambda y0: dae_jax.daesolve(system, dae_jax.RadauIIA5(), 0.0, 0.1, None, y0)
    solve(solve(y0).final)
    with pytest.raises(ValueError, match="violates the equations"):
        solve(y0.at[wrong].add(1e-3))


@pytest.mark.parametrize("orbit", [1.0, ORBIT])
def test_drift_beside_a_large_coordinate(orbit):
    system, (q, v) = unit_vector(orbit=orbit)
    v = v * jnp.array([1.0, 0.0, 1 / TURN])
    with pytest.warns(AccuracyWarning, match="drift"):
        sol = dae_jax.daesolve(system, diffrax.Euler(), 0.0, 2.0, 0.1, (q, v))
    assert float(dae_jax.drift(system, sol).position[-1]) > 0.1


@pytest.mark.parametrize("large", [1.0, 1e6, 1e9])
def test_drift_of_a_dae_beside_a_large_unknown(large):
    def circling(t, y, yd, args):
        x, v, force, count = y[:2], y[2:4], y[4], y[5]
        return jnp.concatenate([yd[:2] - v, yd[2:4] + force * x, jnp.stack([x @ x - 1, yd[5] + 1e-9 * count])])

    system, start = ImplicitDAE(circling), jnp.array([1.0, 0.0, 0.0, 1.0, 1.0, large])
    with pytest.warns(AccuracyWarning, match="drift"):
        sol = dae_jax.daesolve(system, diffrax.Euler(), 0.0, 5.0, 0.1, start)
    assert float(dae_jax.drift(system, sol).levels[0][-1]) > 0.5


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), OrthogonalProjection(diffrax.Tsit5())], ids=["drifts", "keeps"])
def test_what_is_large_and_crosses_zero_has_not_drifted(solver):
    """x = 10⁶ sin t: at both ends 0."""

    def swinging(t, y, yd, args):
        x, v, _ = y
        return jnp.stack([yd[0] - v, x - 1e6 * jnp.sin(t), yd[2] - 1e-6 * x])

    system, start = ImplicitDAE(swinging), jnp.array([0.0, 1e6, 0.0])
    sol = dae_jax.daesolve(system, solver, 0.0, 2 * jnp.pi, None, start)
    assert int(sol.stats["doubts"]) == 0


@pytest.mark.parametrize("amplitude", [0.0, 1e7])
@pytest.mark.parametrize(
    "solver", [OrthogonalProjection(dae_jax.DOP853()), dae_jax.RadauIIA5()], ids=["explicit", "GGL"]
)
def test_what_a_solve_ends_with_is_a_start_at_zeros_too(solver, amplitude):
    """At the turning points of a pendulum, beside an oscillator that is at its largest there, or at zero."""
    system, _ = unit_vector(lambda t, q, v, args: jnp.array([-q[0], 0.0, -1.0]))
    start = jnp.array([amplitude, 1.0, 0.0]), jnp.zeros(3)
    ends = jnp.linspace(0.05, 9.0, 200)
    sol = dae_jax.daesolve(system, solver, 0.0, 9.0, None, start, saveat=diffrax.SaveAt(ts=ends))
    again = lambda t, y: dae_jax.daesolve(system, solver, t, t + 1e-3, None, y, throw=False).result._value
    assert not jnp.any(jax.vmap(again)(ends, sol.ys))


MIXED = jnp.array([1e-3, 1e3, 1e-6, 1e4, 1.0])


def off_of_a_pendulum(solver, tolerance, **options):
    """One that goes round, x in millimetres, y in kilometres, their rates in μm/s and 10 km/s: near y = 0 a bit of x is much of y. How far
    it is off at the end, and whether that was reached.
    """

    def residual(t, state, rates, args):
        (x, y, u, v, pull), (xd, yd, ud, vd, _) = state * MIXED, rates * MIXED
        return jnp.stack([xd - u, yd - v, ud + pull * x, vd + pull * y - 9.81, (x**2 + y**2 - 1) / 2])

    start = jnp.array([0.0, 1.0, 8.0, 0.0, 73.81]) / MIXED
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance * 1e-4)
    system, options = ImplicitDAE(residual), {**options, "stepsize_controller": controller, "throw": False}
    sol = dae_jax.daesolve(system, solver, 0.0, 2.0, None, start, **options)
    swing = lambda t, s: (s[1], -9.81 * np.sin(s[0]))
    angle = solve_ivp(swing, (0, 2), (0, 8), "DOP853", rtol=1e-12, atol=1e-12).y[0, -1]
    off = sol.ys[-1, :2] * MIXED[:2] - np.array([np.sin(angle), np.cos(angle)])
    return np.abs(off).max(), sol.result == dae_jax.RESULTS.successful


@pytest.mark.parametrize("solver", [dae_jax.DOP853(), diffrax.Tsit5()], ids=["dop853", "tsit5"])
def test_a_long_way_back_counts_as_an_error_beside_large_unknowns(solver):
    off, reached = off_of_a_pendulum(OrthogonalProjection(solver), 1e-9)
    assert reached
    assert off < 200e-9


ON_A_SUPPORT = jnp.array([1e-3, 1e3, 1e-6, 1e4, 1e-5])


def off_of_a_pendulum_on_a_moving_support(solver, formulation, tolerance):
    """The same in these units, held at (0.3 sin 2t, 0): how far it is off at saved times, relative to each unknown's largest value, and
    whether the end was reached.
    """
    support = lambda t: 0.3 * jnp.sin(2 * t)

    def residual(t, state, rates, args):
        (x, y, u, v, pull), (xd, yd, ud, vd, _) = state * ON_A_SUPPORT, rates * ON_A_SUPPORT
        across = x - support(t)
        return jnp.stack([xd - u, yd - v, ud + pull * across, vd + pull * y - 9.81, (across**2 + y**2 - 1) / 2])

    ts = np.linspace(0, 2, 41)
    swing = lambda t, s: (s[1], -9.81 * np.sin(s[0]) + 1.2 * np.sin(2 * t) * np.cos(s[0]))
    angle, speed = solve_ivp(swing, (0, 2), (0, 8), "DOP853", rtol=1e-13, atol=1e-13, t_eval=ts).y
    sin, cos = np.sin(angle), np.cos(angle)
    pull = speed**2 + 9.81 * cos + 1.2 * np.sin(2 * ts) * sin
    exact = np.stack([0.3 * np.sin(2 * ts) + sin, cos, 0.6 * np.cos(2 * ts) + cos * speed, -sin * speed, pull], 1)
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance * 1e-4)
    sol = dae_jax.daesolve(
        ImplicitDAE(residual), solver, 0.0, 2.0, None, jnp.asarray(exact[0]) / ON_A_SUPPORT, formulation=formulation,
        saveat=diffrax.SaveAt(ts=jnp.asarray(ts)), stepsize_controller=controller, max_steps=20_000, throw=False,
    )  # fmt: skip
    off = np.abs(np.asarray(sol.ys * ON_A_SUPPORT) - exact) / np.abs(exact).max(0)
    return off.max(), sol.result == dae_jax.RESULTS.successful


@pytest.mark.parametrize(
    ("solver", "formulation", "tolerance"),
    [
        (dae_jax.BDF(), dae_jax.DummyDerivatives(), 1e-7),
        (dae_jax.RadauIIA5(), dae_jax.DummyDerivatives(), 1e-7),
        (dae_jax.DOP853(), dae_jax.DummyDerivatives(), 1e-7),
        (dae_jax.TangentSpace(dae_jax.DOP853()), None, 1e-5),
    ],
    ids=["bdf", "radau", "explicit", "tangent"],
)
def test_states_and_charts_are_chosen_in_any_unit(solver, formulation, tolerance):
    """Near y = 0, which is small in km, x has to follow from y, though its entry in the constraint is small in mm. (In 5 s `BDF`
    was off by 86,000 tolerances, `TangentSpace` in 2 s by 1,000 to 200,000; the others stood still there.)
    """
    off, reached = off_of_a_pendulum_on_a_moving_support(solver, formulation, tolerance)
    assert reached
    assert off < 1000 * tolerance


@pytest.mark.parametrize("method", [OrthogonalProjection, dae_jax.TangentSpace])
def test_with_a_tolerance_for_each_unknown_units_do_not_count(method):
    """The nearest point, and the tangent space's complement, are those of distances in tolerances: with metres beside kilometres and
    millimetres projected as alike, a pendulum was 20 times as far off as in metres.
    """

    def end(unit):
        def swinging(t, y, yd, args):
            (x, v, force), (dx, dv, _) = (jnp.split(z * unit, [2, 4]) for z in (y, yd))
            return jnp.concatenate([dx - v, dv + force * x + jnp.array([0.0, 9.81]), jnp.stack([x @ x - 1])])

        start = np.array([np.sin(1.0), -np.cos(1.0), 0.0, 0.0, 9.81 * np.cos(1.0)]) / unit
        steps = diffrax.PIDController(rtol=1e-6, atol=1e-6 / unit)
        solver = method(diffrax.Bosh3())
        sol = dae_jax.daesolve(ImplicitDAE(swinging), solver, 0.0, 1.5, None, start, stepsize_controller=steps)
        return sol.final * unit, int(sol.stats["num_steps"])

    # Powers of two round as 1 does.
    (alike, steps), (apart, others) = end(np.ones(5)), end(2.0 ** np.array([15, -15, 15, -15, 0]))
    assert steps == others
    np.testing.assert_allclose(apart, alike, rtol=1e-9, atol=1e-9)


def test_beside_a_tolerance_that_is_none_other_constraints_hold():
    """Two pendulums, of which one need not be right: the squares of its tolerances are infinite."""

    def swinging(t, y, yd, args):
        x, v, force, rates = y["x"], y["v"], y["force"], yd["v"] + y["force"][:, None] * y["x"] + jnp.array([0.0, 9.81])
        return {"x": yd["x"] - v, "v": rates, "force": jnp.sum(x**2, 1) - 1 + 0 * force}

    start = {"x": jnp.array([[1.0, 0.0]] * 2), "v": jnp.zeros((2, 2)), "force": jnp.zeros(2)}
    solve = lambda tolerance: dae_jax.daesolve(
        ImplicitDAE(swinging), OrthogonalProjection(diffrax.Tsit5()), 0.0, 1.0, None, start,
        stepsize_controller=diffrax.PIDController(
            rtol=1e-6, atol=jax.tree.map(lambda y: jnp.stack([1e-6 + 0 * y[0], tolerance + 0 * y[0]]), start)
        ),
    )  # fmt: skip
    for loose, tight in zip(*(jax.tree.leaves(solve(tolerance).final) for tolerance in (1e200, 1e-6)), strict=True):
        np.testing.assert_allclose(loose[0], tight[0], rtol=1e-5, atol=1e-5)
