"""A tolerance for each unknown."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import PIDController

import dae_jax
from dae_jax import (
    BDF,
    DOP853,
    Baumgarte,
    ConstrainedSystem,
    DummyDerivatives,
    OrthogonalProjection,
    RadauIIA5,
    TangentSpace,
)
from dae_jax.equations.residual_form import ResidualForm


# x in millimetres, y in kilometres.
UNITS = jnp.array([1e-3, 1e3])
GRAVITY = jnp.array([0.0, -9.81])
PENDULUM = ConstrainedSystem(lambda t, q, v, args: GRAVITY, lambda t, q, args: (q @ q - 1) / 2)
START = jnp.array([1.0, 0.0]), jnp.zeros(2)
MIXED = ConstrainedSystem(
    lambda t, q, v, args: GRAVITY * UNITS, lambda t, q, args: ((q * UNITS) @ (q * UNITS) - 1) / 2, mass=UNITS**2
)
METHODS = {
    "explicit": (diffrax.Tsit5(), None),
    "Baumgarte": (diffrax.Tsit5(), Baumgarte(5.0, 5.0)),
    "projected": (OrthogonalProjection(DOP853()), None),
    "tangent space": (TangentSpace(diffrax.Tsit5()), None),
    "dummy derivatives": (DOP853(), DummyDerivatives()),
    "implicit": (diffrax.Kvaerno5(), None),
    "GGL": (RadauIIA5(), None),
    "BDF": (BDF(), None),
    "Radau": (dae_jax.Radau(), None),
    "reduced": (RadauIIA5(), DummyDerivatives()),
}


def solve(method, controller, system=PENDULUM, start=START, t1=1.0, **options):
    solver, formulation = METHODS[method]
    return dae_jax.daesolve(
        system, solver, 0.0, t1, None, start, formulation=formulation, stepsize_controller=controller, **options
    )


@functools.cache
def plain(method):
    return solve(method, PIDController(1e-6, 1e-6))


@functools.cache
def reference():
    return solve("projected", PIDController(1e-12, 1e-12)).final


@pytest.mark.parametrize("method", METHODS)
def test_units_of_the_unknowns_make_no_difference(method):
    """With tolerances in them. What is chosen by sizes in the user's units, such as the nearest point, may be another."""
    each = 1e-6 / UNITS
    sol = solve(method, PIDController(1e-6, (each, each)), MIXED, tuple(x / UNITS for x in START))
    for x, exact in zip(sol.final, reference(), strict=True):
        np.testing.assert_array_less(jnp.abs(x * UNITS - exact), 100e-6 * (1 + jnp.abs(exact)))
    assert int(sol.stats["num_steps"]) <= 1.4 * int(plain(method).stats["num_steps"])


@pytest.mark.parametrize("method", METHODS)
def test_equal_ones_are_one_number(method):
    sol = solve(method, PIDController((1e-6, np.full(2, 1e-6)), jnp.full(2, 1e-6)))
    assert int(sol.stats["num_steps"]) == int(plain(method).stats["num_steps"])
    for x, y in zip(sol.final, plain(method).final, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
    assert sol.precision == "float64, rtol for each unknown, atol for each unknown"


@pytest.mark.parametrize("solver", [DOP853(), RadauIIA5(), BDF()], ids=["explicit", "Radau", "BDF"])
def test_what_is_loose_is_not_followed(solver):
    """A slow decay beside a fast vibration, which alone needs the steps."""

    def residual(t, y, rates, args):
        return {"slow": rates["slow"] + y["slow"], "x": rates["x"] - 300 * y["u"], "u": rates["u"] + 300 * y["x"]}

    def steps(atol):
        start = {"slow": jnp.ones(()), "u": 1e-3 * jnp.ones(()), "x": jnp.zeros(())}
        controller = PIDController(0.0, {"slow": 1e-7, "u": atol, "x": atol})
        sol = dae_jax.daesolve(
            dae_jax.ImplicitDAE(residual), solver, 0.0, 1.0, None, start, stepsize_controller=controller
        )
        np.testing.assert_allclose(sol.final["slow"], np.exp(-1), atol=1e-5)
        return int(sol.stats["num_steps"])

    assert steps(1e-1) < steps(1e-7) / 2


@pytest.mark.parametrize("method", ["projected", "dummy derivatives", "GGL", "BDF"])
def test_derivatives(method):
    controller = PIDController(1e-10, (1e-10, jnp.array([1e-9, 1e-11])))
    of = lambda rate: solve(method, controller, start=(START[0], jnp.stack([0 * rate, rate]))).final[0][1]
    tight = PIDController(1e-12, 1e-12)
    exact = lambda rate: solve("projected", tight, start=(START[0], jnp.stack([0 * rate, rate]))).final[0][1]
    difference = (exact(0.301) - exact(0.299)) / 2e-3
    np.testing.assert_allclose(jax.grad(of)(0.3), difference, rtol=2e-6)
    np.testing.assert_allclose(jax.jvp(of, (0.3,), (1.0,))[1], difference, rtol=2e-6)


def test_batches_of_them_equal_one_at_a_time():
    steps = lambda tolerance: solve("projected", PIDController(1e-7, (tolerance, 10 * tolerance))).stats["num_steps"]
    tolerances = jnp.array([1e-3, 1e-6, 1e-9])
    assert jax.vmap(steps)(tolerances).tolist() == [int(steps(x)) for x in tolerances]


def test_between_steps_that_are_clipped():
    clipped = diffrax.ClipStepSizeController(PIDController(1e-6, (1e-6, jnp.full(2, 1e-6))), jump_ts=jnp.array([0.5]))
    plain = diffrax.ClipStepSizeController(PIDController(1e-6, 1e-6), jump_ts=jnp.array([0.5]))
    each, one = (solve("explicit", controller) for controller in (clipped, plain))
    np.testing.assert_allclose(each.final[0], one.final[0], rtol=1e-12)
    assert int(each.stats["num_steps"]) == int(one.stats["num_steps"])


def test_a_norm_of_the_user_gets_the_state():
    of_positions = lambda x: jnp.max(jnp.abs(x[0]))
    each = solve("explicit", PIDController(1e-6, (1e-6, jnp.full(2, 1e-6)), norm=of_positions))
    one = solve("explicit", PIDController(1e-6, 1e-6, norm=of_positions))
    assert int(each.stats["num_steps"]) == int(one.stats["num_steps"]) != int(plain("explicit").stats["num_steps"])


def test_resets_know_what_each_unknown_is_off_by():
    """A ball that falls from a micrometre, beside a tank of a thousand tonnes that runs empty."""
    metre = 1e-6
    ball = dae_jax.ImplicitDAE(
        lambda t, y, rates, args: {
            "h": rates["h"] - y["v"], "v": rates["v"] + 9.81 * metre, "tank": rates["tank"] + y["tank"]
        }
    )  # fmt: skip
    bounce = dae_jax.Reset(
        lambda t, y, args, **kwargs: y["h"], lambda t, y, args: ({**y, "v": -y["v"]}, args), direction=False
    )
    start = {"h": metre * jnp.ones(()), "v": jnp.zeros(()), "tank": 1e6 * jnp.ones(())}
    each = {"h": 1e-9 * metre, "v": 1e-9 * metre, "tank": 1.0}
    sol = dae_jax.daesolve(
        ball, DOP853(), 0.0, 2.0, None, start, event=bounce, stepsize_controller=PIDController(1e-9, each)
    )
    fall = np.sqrt(2 / 9.81)
    np.testing.assert_allclose(sol.stats["jump_times"][: int(sol.stats["jumps"])], fall * np.array([1, 3]), rtol=1e-6)


def test_multipliers_have_those_of_the_velocities_along_their_constraint():
    form = ResidualForm.of(PENDULUM, 0.0, START, None, "GGL")
    turned = jnp.array([0.6, 0.8]), jnp.zeros(2)
    each = jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    of_q, of_v = np.hypot(0.6 * 1, 0.8 * 2), np.hypot(0.6 * 3, 0.8 * 5)
    np.testing.assert_allclose(form.tolerances(0.0, turned, each, False), [1, 2, 3, 5, of_v, of_v], rtol=1e-14)
    np.testing.assert_allclose(form.tolerances(0.0, turned, each, True), [1, 2, 3, 5, of_v**2 / of_q, of_v], rtol=1e-14)
    scale = [1 / 3, 2 / 5, 1 / 3, 2 / 5, of_q / of_v, of_q / of_v]
    np.testing.assert_allclose(form.time_scale(0.0, turned, each), scale, rtol=1e-14)


def test_numbers_by_name_are_for_each_unknown():
    decay = dae_jax.ImplicitDAE(lambda t, y, yd, args: {"x": yd["x"] + y["x"], "z": y["z"] - y["x"]})
    start = {"x": jnp.ones(()), "z": jnp.ones(())}
    controller = PIDController(1e-6, {"x": 1e-6, "z": 1e-3})
    sol = dae_jax.daesolve(decay, DOP853(), 0.0, 1.0, None, start, stepsize_controller=controller)
    assert sol.precision == "float64, rtol 1e-06, atol for each unknown"


def test_below_round_off_in_float32():
    decay = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd + y)
    with pytest.raises(RuntimeError, match=r"rtol = 1e-12 and atol = 1e-12, are below round-off, which is 1\.2e-07"):
        dae_jax.daesolve(
            decay,
            diffrax.Tsit5(),
            0.0,
            1.0,
            None,
            jnp.ones(2, jnp.float32),
            stepsize_controller=PIDController(1e-12, 1e-12),
        )


def test_below_round_off_of_one_unknown():
    decay = dae_jax.ImplicitDAE(lambda t, y, yd, args: yd + y)
    controller = PIDController(0.0, jnp.array([1e-6, 1e-22]))
    with pytest.raises(RuntimeError, match=r"rtol = 0 and atol = 1e-22, are below round-off"):
        dae_jax.daesolve(decay, RadauIIA5(), 0.0, 1.0, None, jnp.ones(2), stepsize_controller=controller)


@pytest.mark.parametrize("method", ["GGL", "BDF", "Radau", "reduced"])
def test_the_unit_of_time_is_of_no_account(method):
    """A pendulum that swings in nanoseconds, or in decades, takes the steps of one that swings in seconds."""
    system = ConstrainedSystem(lambda t, q, v, unit: GRAVITY * unit**2, PENDULUM.constraint)
    solver, formulation = METHODS[method]

    @jax.jit
    def solved(unit):
        start = jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6]) * unit
        controller = PIDController(1e-8, (1e-8, 1e-8 * unit))
        sol = dae_jax.daesolve(
            system, solver, 0.0, 1 / unit, None, start, unit, formulation=formulation, stepsize_controller=controller
        )
        return sol.stats["num_steps"], sol.final[0], sol.final[1] / unit

    steps, q, v = solved(1.0)
    for unit in (2.0**-30, 2.0**30):
        others, *state = solved(unit)
        # Which order `Radau` takes is a matter of round-off.
        assert abs(others - steps) <= (0.3 * steps if method == "Radau" else 0)
        np.testing.assert_allclose(state, (q, v), atol=1e-8)
