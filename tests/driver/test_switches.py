"""Steps in which the equations switch with time and back: the answer is right, or a warning says that a pulse may have been missed."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import AccuracyWarning
from dae_jax.driver.problem import Problem
from dae_jax.driver.switches import stepped_over


START = (jnp.array([0.0, 0.0]), jnp.array([0.0, 0.0]))
# 1 in this part of each unit of time, else 0.
PERIOD, WIDTH = 1.0, 0.03


def bead(drive):
    """On a straight wire, q̈ = drive(t, q): the double integral of it is known."""
    return dae_jax.ConstrainedSystem(
        lambda t, q, v, args: jnp.stack([drive(t, q), jnp.zeros(())]), lambda t, q, args: q[1]
    )


def pulses(t, q):
    return jnp.where(t % PERIOD < WIDTH, 1.0, 0.0)


def velocity(t):
    """∫ pulses dt."""
    return WIDTH * np.floor(t / PERIOD) + np.minimum(t % PERIOD, WIDTH)


def solved(drive, solver, t1=4.5, dt0=None, controller=None, **rest):
    controller = controller or diffrax.PIDController(rtol=1e-6, atol=1e-6)
    steps = {} if dt0 else {"stepsize_controller": controller}
    return dae_jax.daesolve(bead(drive), solver, 0.0, t1, dt0, START, None, **steps, **rest)


METHODS = {
    "projection": (dae_jax.OrthogonalProjection(dae_jax.DOP853()), None),
    "tsit5": (diffrax.Tsit5(), None),
    "radau": (dae_jax.RadauIIA5(), None),
    "radau of order 5 to 13": (dae_jax.Radau(), None),
    "bdf": (dae_jax.BDF(), None),
    "dummy derivatives": (dae_jax.DOP853(), dae_jax.DummyDerivatives()),
}


@pytest.mark.parametrize("name", METHODS)
def test_right_or_doubted(name):
    solver, formulation = METHODS[name]
    with pytest.warns(AccuracyWarning, match="switch more than once with time"):
        sol = solved(pulses, solver, formulation=formulation)
    wrong = abs(float(sol.final[1][0]) - velocity(4.5)) > 1e-3
    # All of these step over pulses; who does not is no witness.
    assert wrong
    assert int(sol.stats["doubts"]) == 16


@pytest.mark.parametrize("name", METHODS)
def test_no_doubt_where_the_times_are_known_or_steps_are_short(name):
    solver, formulation = METHODS[name]
    times = np.sort(np.concatenate([np.arange(5) * PERIOD, np.arange(5) * PERIOD + WIDTH]))[1:]
    tight = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    for controller in (
        diffrax.ClipStepSizeController(tight, jump_ts=times),
        diffrax.PIDController(rtol=1e-8, atol=1e-8, dtmax=WIDTH / 2),
    ):
        sol = solved(pulses, solver, controller=controller, formulation=formulation)
        assert int(sol.stats["doubts"]) == 0
        np.testing.assert_allclose(sol.final[1][0], velocity(4.5), atol=1e-5)


def trapezoid(t, q):
    return jnp.clip((t - 1.4) / 0.02, 0, 1) - jnp.clip((t - 1.45) / 0.02, 0, 1)


SHAPES = {
    "between two times": lambda t, q: jnp.where((t > 1.4) & (t < 1.5), 1.0, 0.0),
    "one after another": lambda t, q: jnp.where(t > 1.4, jnp.where(t > 1.5, 0.0, 1.0), 0.0),
    "trapezoid": trapezoid,
    "triangle": lambda t, q: jnp.maximum(0.0, 1 - jnp.abs(t - 1.45) / 0.05),
    "square wave": lambda t, q: jnp.sign(jnp.sin(40 * t)),
    "every other": lambda t, q: jnp.where(jnp.floor(10 * t) % 2 == 0, 1.0, 0.0),
    "on a state too": lambda t, q: jnp.where((q[0] < 5) & (jnp.abs(t - 1.45) < 0.05), 1.0, 0.0),
    "within jit": lambda t, q: jax.jit(lambda s: jnp.where((s > 1.4) & (s < 1.5), 1.0, 0.0))(t),
}


@pytest.mark.filterwarnings("ignore::dae_jax.AccuracyWarning")
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("backwards", [False, True], ids=["forwards", "backwards"])
def test_however_it_is_written(shape, backwards):
    """A fixed step from 1.25 to 1.75."""
    solver = dae_jax.OrthogonalProjection(diffrax.Midpoint())
    t0, t1 = (2.25, 0.25) if backwards else (0.25, 2.25)
    dt0 = -0.5 if backwards else 0.5
    sol = dae_jax.daesolve(bead(SHAPES[shape]), solver, t0, t1, dt0, START)
    assert int(sol.stats["doubts"]) & 16


def test_no_doubt_about_one_switching_or_one_by_the_state():
    once = solved(lambda t, q: jnp.where(t > 1.4, 1.0, 0.0), *METHODS["projection"][:1])
    np.testing.assert_allclose(once.final[1][0], 3.1, atol=1e-4)
    by_state = solved(lambda t, q: jnp.where(q[0] > 1, -1.0, 1.0), *METHODS["projection"][:1])
    assert int(once.stats["doubts"]) == int(by_state.stats["doubts"]) == 0


def test_each_lane_for_itself():
    def doubts(width):
        drive = lambda t, q: jnp.where((t > 1.4) & (t < 1.4 + width), 1.0, 0.0)
        return solved(drive, *METHODS["projection"][:1]).stats["doubts"]

    # The second pulse lasts to the end.
    np.testing.assert_array_equal(jax.jit(jax.vmap(doubts))(jnp.array([0.04, 4.0])), [16, 0])


def test_is_looked_for_only_where_equations_switch_with_time():
    problem = lambda drive: Problem(bead(drive), jnp.zeros(()), jnp.ones(()), None, START, None, None)
    assert stepped_over(problem(lambda t, q: jnp.sin(t) + jnp.maximum(q[0], 0.0))) is None
    seen = stepped_over(problem(pulses))
    assert seen is not None
    assert all(eqn.primitive.name in ("rem", "lt", "ne", "and", "select_n", "add") for eqn in seen.comparisons.eqns)


def test_a_reset_has_the_derivative_by_a_switching_time():
    """The force ends at t = τ: v(2) = 2τ. By `where` the derivative lacks it, as that of `where` itself does, and a warning says so."""

    def speed(tau, event, force):
        system = dae_jax.ConstrainedSystem(force, lambda t, q, args: q[1])
        args = {"tau": tau, "force": jnp.array([2.0, 0.0])}
        return dae_jax.daesolve(
            system, METHODS["projection"][0], 0.0, 2.0, None, START, args, event=event
        ).final[1][0]  # fmt: skip

    off = dae_jax.Reset(
        lambda t, y, args, **kwargs: t - args["tau"], lambda t, y, args: (y, {**args, "force": 0 * args["force"]})
    )
    with_reset = lambda tau: speed(tau, off, lambda t, q, v, args: args["force"])
    by_where = lambda tau: speed(tau, None, lambda t, q, v, args: jnp.where(t < args["tau"], args["force"], 0.0))
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(with_reset)(0.7), 2.0, rtol=1e-9)
    with pytest.warns(AccuracyWarning, match="switch at a time"):
        assert jax.grad(by_where)(0.7) == jax.jacfwd(by_where)(0.7) == 0


SWITCHED = {
    "jump": lambda t, a: jnp.where(t < a["time"], 0.0, a["size"]),
    "pulses": lambda t, a: jnp.where(t % 1.0 < a["time"], a["size"], 0.0),
    "sign": lambda t, a: a["size"] * jnp.sign(t - a["time"]),
}
STILL = {
    "ramp": lambda t, a: a["size"] * jnp.maximum(0.0, t - a["time"]),
    "fixed": lambda t, a: jnp.where(t < 1.0, 0.0, a["size"] * a["time"]),
    "size": lambda t, a: a["time"] * jnp.where(t < a["size"], 0.0, 1.0),
}


class TestDerivatives:
    """By the time of a switch, which is known to them only where it is announced as it depends on what they are by."""

    def traced(self, of, announced=None):
        system = dae_jax.SemiExplicitDAE(lambda t, x, z, a: z, lambda t, x, z, a: z - of(t, a))

        def end(time):
            args = {"time": time, "size": jnp.ones(())}
            control = diffrax.PIDController(rtol=1e-6, atol=1e-6)
            if announced is not None:
                control = diffrax.ClipStepSizeController(control, jump_ts=announced(time))
            start = jnp.zeros(()), jnp.zeros(())
            return dae_jax.daesolve(
                system, dae_jax.DOP853(), 0.0, 2.0, None, start, args, stepsize_controller=control
            ).ys[0][-1]  # fmt: skip

        jax.eval_shape(jax.grad(end), jnp.asarray(1.1))

    @pytest.mark.parametrize("name", SWITCHED)
    @pytest.mark.parametrize("announced", [None, lambda time: jnp.array([1.1])], ids=["unknown", "as a constant"])
    def test_warn(self, name, announced):
        with pytest.warns(AccuracyWarning, match="switch at a time that depends on what is differentiated"):
            self.traced(SWITCHED[name], announced)

    @pytest.mark.parametrize("name", STILL)
    def test_do_not_where_no_jump_moves(self, name):
        self.traced(STILL[name])

    def test_do_not_where_it_is_known(self):
        self.traced(SWITCHED["jump"], lambda time: time[None])
