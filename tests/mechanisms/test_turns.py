"""Angles in space, whose whole turns are not known: what is right all the same, and what says that it is not."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.mechanisms.bodies import wrench


ROD = m.Body("rod", 1.0, (0.1, 0.1, 0.01), at=(0.5, 0, 0))
HINGE = m.revolute(m.ground, ROD, (0, 0, 0), axis=(0, 0, 1), name="hinge")
SOLVER = dae_jax.OrthogonalProjection(diffrax.Tsit5())


def angle_of(mechanism, q):
    return float(HINGE.angle(mechanism.configuration(q)))


@pytest.mark.parametrize("wanted", [2.0, -2.5, 2 * np.pi + 1])
@pytest.mark.parametrize("held", ["motor", "coupling", "at"])
def test_an_angle_that_is_given_is_taken_on_its_own_side(held, wanted):
    parts = {
        "motor": [m.motor(HINGE, motion=lambda t, args: wanted + 0 * t)],
        "coupling": [m.coupling(HINGE, None, (wanted,))],
        "at": [],
    }
    mechanism = m.Mechanism([ROD], [HINGE, *parts[held]])
    q, _ = mechanism.assemble(at={"hinge": wanted} if held == "at" else None)
    assert angle_of(mechanism, q) == pytest.approx((wanted + np.pi) % (2 * np.pi) - np.pi, abs=1e-9)


def test_a_motor_holds_a_rod_beyond_a_right_angle():
    motor = m.motor(HINGE, motion=lambda t, args: 2.0 + 0 * t, name="motor")
    mechanism = m.Mechanism([ROD], [HINGE], [motor, m.gravity((0, -9.81, 0))])
    sol = dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, 0.5, None, mechanism.assemble())
    np.testing.assert_allclose(mechanism.effort(sol, "motor"), 9.81 * 0.5 * np.cos(2.0), rtol=1e-9)


def test_a_spring_fails_at_half_a_turn_and_is_right_before():
    mechanism = m.Mechanism([ROD], [HINGE], [m.spring(HINGE, 1.0)])
    rate, frequency = 8.0, np.sqrt(1 / 0.26)
    y0 = mechanism.assemble(rates={"hinge": rate})
    solve = lambda t1: dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, t1, None, y0)
    np.testing.assert_allclose(
        mechanism.coordinate(solve(0.3), "hinge"), rate / frequency * np.sin(0.3 * frequency), rtol=1e-7
    )
    with pytest.raises(RuntimeError, match="so is 'spring on hinge', whose angle in space has come to half a turn"):
        solve(1.5)


def test_a_spring_takes_either_quaternion_of_an_orientation():
    """One that a guess has by hand, of any length: e and −e are one orientation, and springs know one of them."""
    bob = m.Body("bob", 1.0, (0.1, 0.1, 0.1), at=(1.0, 0, 0))
    pin = m.revolute(ROD, bob, (1, 0, 0), axis=(0, 0, 1), name="pin")
    mechanism = m.Mechanism([ROD, bob], [HINGE, pin], [m.spring(pin, 2.0), m.spring(HINGE, 1.0)])
    turned = lambda angle, length: length * np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    rod = np.array([0.5 * np.cos(1.9), 0.5 * np.sin(1.9), 0, *turned(1.9, -1.0)])
    q, v = mechanism.assemble({"rod": rod, "bob": np.array([np.cos(1.9), np.sin(1.9), 0, *turned(-0.6, 3.0)])})
    # The bob has turned by −0.6 and the rod by 1.9, with springs at these angles.
    moments = mechanism.force(0.0, q, v, None)
    for body, moment in (("rod", 2.0 * -2.5 - 1.9), ("bob", 2.0 * 2.5)):
        np.testing.assert_allclose(wrench(q[body], moments[body])[1], (0, 0, moment), atol=1e-9)


def test_an_angle_that_turns_too_fast_for_its_saved_times_is_doubted():
    mechanism = m.Mechanism([ROD], [HINGE])
    y0 = mechanism.assemble(rates={"hinge": -5.0})
    save = lambda n: diffrax.SaveAt(ts=jnp.linspace(0, 2, n))
    solve = lambda n: dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, 2.0, None, y0, saveat=save(n))
    np.testing.assert_allclose(mechanism.coordinate(solve(5), "hinge")[-1], -10.0, rtol=1e-6)
    with pytest.warns(
        dae_jax.AccuracyWarning, match="'hinge', an angle in space, .* times 0 and 1 it turns by about 5 rad"
    ):
        mechanism.coordinate(solve(3), "hinge")


def test_a_load_that_is_not_finite_is_named():
    late = m.motor(HINGE, torque=lambda t, c, rate, args: jnp.sqrt(0.1 - t), name="drive")
    mechanism = m.Mechanism([ROD], [HINGE], [m.gravity((0, -9.81, 0)), late, m.spring(HINGE, 1.0)])
    with pytest.raises(RuntimeError, match=r"not finite just beyond t = \S+; so is 'drive'\."):
        dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, 0.5, None, mechanism.assemble())


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 2, -2)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_spring_fails_where_a_step_leaps_over_half_a_turn(axis, sign):
    """Steps of 0.6 rad a stage, by a tolerance that the turning allows; also of a body that is turned at the start."""
    body = m.Body("wheel", 1.0, (1.0, 1.0, 1.0), orientation=(0.5, 0, 0.8, 0.3))
    hinge = m.revolute(m.ground, body, (0, 0, 0), axis=axis, name="hinge")
    mechanism = m.Mechanism([body], [hinge], [m.spring(hinge, 1.0)])
    steps = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    solve = lambda rate, t1: dae_jax.daesolve(
        mechanism.system(),
        SOLVER,
        0.0,
        t1,
        None,
        mechanism.assemble(rates={"hinge": sign * rate}),
        stepsize_controller=steps,
    )
    swings = solve(2.5, 2.0)
    np.testing.assert_allclose(mechanism.coordinate(swings, "hinge")[-1], sign * 2.5 * np.sin(2.0), atol=0.05)
    for rate in (30.0, 100.0, 300.0):
        with pytest.raises(RuntimeError, match="is not finite just beyond"):
            solve(rate, 20.0 / rate)


@pytest.mark.parametrize(("ratio", "b"), [(2.0, 3.5), (-1.0, 4.0), (0.5, 3.5)])
def test_gears_of_whole_ratios_turn_on(ratio, b):
    other = m.Body("other", 1.0, (0.1, 0.1, 0.1), at=(0, 3, 0))
    of_other = m.revolute(m.ground, other, (0, 3, 0), axis=(0, 0, 1), name="of other")
    mechanism = m.Mechanism([ROD, other], [HINGE, of_other, m.coupling(HINGE, of_other, (0, ratio))])
    turned = m.Mechanism([ROD, other], [HINGE, of_other]).assemble(at={"hinge": ratio * b, "of other": b})
    np.testing.assert_allclose(mechanism.constraint(0.0, turned[0], None), 0, atol=1e-9)


def test_a_screw_counts_no_turns():
    nut = m.Body("nut", 1.0, (0.1, 0.1, 0.1))
    screw = m.cylindrical(m.ground, nut, axis=(0, 0, 1), name="screw")
    mechanism = m.Mechanism([nut], [screw, m.coupling(screw.displacement, screw.angle, (0.05, 0.1))])
    for turn in (0.3, 4.0, 9.0):
        q = mechanism.reference[0].put(
            "nut", jnp.array([0, 0, 0.05 + 0.1 * turn, np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
        )
        np.testing.assert_allclose(mechanism.constraint(0.0, q, None), 0, atol=1e-12)


def test_a_joint_that_closes_the_wrong_way_round_is_named():
    upside_down = jnp.array([0.5, 0, 0, np.cos(1.5), np.sin(1.5), 0, 0])
    with pytest.raises(ValueError, match="joint 'hinge' closes the wrong way round"):
        m.Mechanism([ROD], [HINGE]).assemble({"rod": upside_down})


@pytest.mark.parametrize("through", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_derivatives_go_through_what_is_assembled(through):
    def tip(design):
        rod = m.Body("rod", 1.0, (0.1, 0.1, 0.01), at=jnp.stack([design["length"], jnp.zeros(()), jnp.zeros(())]))
        hinge = m.revolute(m.ground, rod, (0, 0, 0), axis=(0, 0, 1), name="hinge")
        q, v = m.Mechanism([rod], [hinge]).assemble(at={"hinge": design["angle"]}, rates={"hinge": design["rate"]})
        return q["rod"][0] + v["rod"][1]

    length, angle, rate = 0.5, 0.7, 3.0
    found = through(jax.grad(tip))({"length": jnp.array(length), "angle": jnp.array(angle), "rate": jnp.array(rate)})
    # x + ẏ = L cos θ + L ω cos θ.
    assert found["length"] == pytest.approx((1 + rate) * np.cos(angle), rel=1e-9)
    assert found["angle"] == pytest.approx(-(1 + rate) * length * np.sin(angle), rel=1e-9)
    assert found["rate"] == pytest.approx(length * np.cos(angle), rel=1e-9)


def test_what_fills_up_the_steps_is_no_turn():
    mechanism = m.Mechanism([ROD], [HINGE])
    y0 = mechanism.assemble(rates={"hinge": -5.0})
    save = diffrax.SaveAt(t0=True, steps=True)
    sol = dae_jax.daesolve(mechanism.system(), SOLVER, 0.0, 0.5, 0.1, y0, saveat=save)
    angle = mechanism.coordinate(sol, "hinge")[np.isfinite(sol.ts)]
    np.testing.assert_allclose(angle, np.linspace(0, -2.5, 6), rtol=1e-3)
