"""The rows of a state go with a mechanism's bodies: states of other bodies, or in another order, never pass as its own."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m


BODIES = [m.Body("light", 1.0, 0.1, at=(0.5, 0)), m.Body("heavy", 50.0, 0.3, at=(1.5, 0))]
JOINTS = [m.revolute(m.ground, BODIES[0], (0, 0), name="h"), m.revolute(*BODIES, (1, 0), name="k")]
ONE, OTHER = (m.Mechanism(bodies, JOINTS, [m.gravity((0, -9.81))]) for bodies in (BODIES, BODIES[::-1]))
NAMED_OTHERWISE = m.Mechanism(
    [m.Body("arm", 1.0, 0.1)], [m.revolute(m.ground, m.Body("arm", 1.0, 0.1), (0, 0), name="h")]
)


def solved(mechanism: m.Mechanism, y0) -> dae_jax.DAESolution:
    solver = dae_jax.OrthogonalProjection(dae_jax.DOP853())
    return dae_jax.daesolve(mechanism.system(), solver, 0.0, 0.1, None, y0, saveat=diffrax.SaveAt(t1=True))


def test_a_guess_may_be_a_state_in_another_order():
    y0 = OTHER.assemble(at={"h": 0.3, "k": -0.2}, rates={"h": 1.0, "k": 2.0})
    q, v = ONE.assemble(y0)
    assert q.names == ("light", "heavy")
    for name in q.names:
        np.testing.assert_allclose(q[name], y0[0][name], atol=1e-12)
        np.testing.assert_allclose(v[name], y0[1][name], atol=1e-12)


def test_a_guess_may_be_a_state_of_some_of_the_bodies():
    q, _ = m.Mechanism(BODIES[:1], JOINTS[:1]).assemble(at={"h": 0.3})
    found, by_name = (ONE.assemble(guess)[0].values for guess in (q, {"light": q["light"]}))
    np.testing.assert_array_equal(found, by_name)


def test_what_has_a_value_and_no_rate_moves_as_the_guess_does():
    arm = m.Body("arm", 1.0, 0.1, at=(0.5, 0), spin=4.0, velocity=(0, 2.0))
    free = m.Mechanism([arm], [m.revolute(m.ground, arm, (0, 0), name="h")])
    # Nearest to the velocities of the guess, in the metric of masses: (J + m r²) ω = J 4 + m r·(0, 2).
    _, v = free.assemble(at={"h": 0.3})
    assert float(v["arm"][2]) == pytest.approx((0.1 * 4 + 0.5 * 2 * np.cos(0.3)) / 0.35, rel=1e-9)
    assert float(free.assemble(at={"h": 0.3}, rates={"h": 0.0})[1]["arm"][2]) == pytest.approx(0, abs=1e-12)


def test_what_is_driven_has_the_rate_of_its_motor_where_only_its_value_is_given():
    drive = m.motor(JOINTS[0], motion=lambda t, args: 0.3 + 2 * t)
    q, v = m.Mechanism(BODIES, JOINTS, [drive]).assemble(at={"h": 0.3, "k": 0.1})
    assert float(q["heavy"][2] - q["light"][2]) == pytest.approx(0.1, abs=1e-9)
    assert float(v["light"][2]) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize(
    ("length", "mass", "given"),
    [(1e-4, 1e-9, "rates"), (1e6, 1e9, "at")],
    ids=["0.1 mm", "in µm"],
)
def test_what_is_assembled_is_so_in_any_unit(length, mass, given):
    def assembled(length, mass):
        make = lambda name, m0, moments, at: m.Body(name, m0 * mass, moments * mass * length**2, at=at * length)
        arm = make("arm", 2.0, np.array([0.2, 0.3, 0.25]), np.array([0.3, 0, 0]))
        bob = make("bob", 1.0, np.array([0.1, 0.15, 0.12]), np.array([0.3, 0.4, 0.2]))
        hinge = m.revolute(m.ground, arm, (0, 0, 0), axis=(0, 1, 0), name="hinge")
        pin = m.revolute(arm, bob, np.array([0.3, 0.2, 0]) * length, axis=(1, 0, 0.3), name="pin")
        mechanism = m.Mechanism([arm, bob], [hinge, pin])
        q, v = mechanism.assemble(**{given: {"hinge": 0.2} if given == "at" else {"hinge": 1.0, "pin": -2.0}})
        units = np.array([length] * 3 + [1] * 4)
        return q.values / units, v.values / units

    for found, right in zip(assembled(length, mass), assembled(1.0, 1.0), strict=True):
        np.testing.assert_allclose(found, right, atol=1e-9)


@pytest.mark.parametrize(("length", "mass"), [(1.0, 1.0), (1e-8, 1e-16), (1e9, 1e6)])
def test_how_many_equations_are_independent_is_so_in_any_unit(length, mass):
    """A parallelogram in space: three of its 23 equations follow from the others, and it moves."""
    make = lambda name, m0, *at: m.Body(name, m0 * mass, np.full(3, 0.1 * mass * length**2), at=np.array(at) * length)
    left, top, right = make("left", 1.0, 0.3, 0.4, 0), make("top", 2.0, 1.35, 0.8, 0), make("right", 1.3, 1.8, 0.4, 0)
    ends = [(m.ground, left, (0, 0)), (left, top, (0.6, 0.8)), (top, right, (2.1, 0.8)), (right, m.ground, (1.5, 0))]
    joints = [m.revolute(a, b, np.array([*at, 0]) * length, axis=(0, 0, 1)) for a, b, at in ends]
    mechanism = m.Mechanism([left, top, right], joints)
    assert mechanism.rank(mechanism.reference) == (20, 20)


@pytest.mark.parametrize(
    "take",
    [
        lambda q, v: ONE.mass(q),
        lambda q, v: ONE.force(0.0, q, v, None),
        lambda q, v: ONE.force(0.0, ONE.reference[0], v, None),
        lambda q, v: ONE.constraint(0.0, q, None),
        lambda q, v: ONE.potential(q, None),
        lambda q, v: ONE.rank((q, v)),
        lambda q, v: solved(ONE, (q, v)),
    ],
    ids="mass force velocities constraint potential rank solve".split(),
)
def test_a_state_in_another_order_is_refused(take):
    with pytest.raises(
        ValueError, match=r"has the bodies light, heavy, in this order, .* of another mechanism, with heavy, light"
    ):
        take(*OTHER.reference)


@pytest.mark.parametrize(
    "show",
    [
        lambda sol: ONE.coordinate(sol, "h"),
        lambda sol: ONE.rate(sol, "h"),
        lambda sol: ONE.reaction(sol, "h"),
        lambda sol: ONE.energy(sol),
    ],
    ids="coordinate rate reaction energy".split(),
)
@pytest.mark.parametrize("mechanism", [OTHER, NAMED_OTHERWISE], ids=["order", "names"])
def test_a_solution_of_another_mechanism_is_refused(mechanism, show):
    with pytest.raises(ValueError, match="this one is of another mechanism, with"):
        show(solved(mechanism, mechanism.reference))


TIMES = jnp.linspace(0.0, 0.2, 3)
DRIVE = m.motor(JOINTS[0], torque=lambda t, c, rate, args: args, name="drive")
LEAD = m.motor(JOINTS[1], motion=lambda t, args: args * t, name="lead")
DRIVEN = m.Mechanism(BODIES, [*JOINTS, LEAD], [DRIVE])


def driven(torque, saveat):
    y0, solver = DRIVEN.assemble(args=torque), dae_jax.OrthogonalProjection(dae_jax.DOP853())
    return dae_jax.daesolve(DRIVEN.system(rank=5), solver, 0.0, 0.2, None, y0, torque, saveat=saveat)


def test_of_a_batch_of_solutions_each_is_shown():
    shown = lambda sol: [
        DRIVEN.coordinate(sol, "h"),
        DRIVEN.rate(sol, "h"),
        DRIVEN.effort(sol, "drive"),
        DRIVEN.effort(sol, "lead"),
        *DRIVEN.reaction(sol, "k"),
        DRIVEN.power(sol),
    ]
    torques = jnp.array([1.0, -4.0])
    solve = lambda torque: driven(torque, diffrax.SaveAt(ts=TIMES))
    batch = jax.vmap(solve)(torques)
    each = jax.tree.map(lambda *x: jnp.stack(x), *(shown(solve(torque)) for torque in torques))
    for found, wanted in zip(jax.tree.leaves(shown(batch)), jax.tree.leaves(each), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-8)
    with pytest.raises(ValueError, match=r"takes one solution, but `sol` is a batch: `jax.vmap"):
        DRIVEN.inverse_dynamics(batch, ["h", "k"])


@pytest.mark.parametrize(
    ("saveat", "said"),
    [
        (diffrax.SaveAt(dense=True), r"`sol` must have saved states: `SaveAt\(t1=True\)`"),
        (diffrax.SaveAt(ts=TIMES, fn=lambda t, y, args: y[0]), r"leave out `SaveAt\(fn=...\)`"),
    ],
)
def test_a_solution_without_states_is_refused(saveat, said):
    sol = driven(1.0, saveat)
    for show in (
        lambda: DRIVEN.coordinate(sol, "h"),
        lambda: DRIVEN.effort(sol, "lead"),
        lambda: DRIVEN.reaction(sol, "k"),
        lambda: DRIVEN.power(sol),
        lambda: DRIVEN.inverse_dynamics(sol, ["h"]),
    ):
        with pytest.raises(ValueError, match=said):
            show()


def test_what_loads_are_does_not_matter_to_closing():
    """By a stiffness everything that is assembled stays known, so that it is not compiled once more for a derivative."""
    seen = []

    def assembled(stiffness):
        mechanism = m.Mechanism(BODIES, JOINTS, [m.spring(JOINTS[0], stiffness)])
        seen.append(mechanism.assemble(at={"h": 0.3, "k": -0.2})[0].values)
        return jnp.sum(seen[-1]) + stiffness

    assert jax.grad(assembled)(3.0) == 1.0
    np.testing.assert_array_equal(seen[0], ONE.assemble(at={"h": 0.3, "k": -0.2})[0].values)


def test_what_a_load_acts_along_may_have_a_value():
    between = m.between(m.ground, BODIES[1], ((0.0, 1.0), (1.5, 0.0)))
    for load in (m.spring(between, 3.0, name="s"), m.damper(between, 0.1, name="s")):
        q, v = m.Mechanism(BODIES, JOINTS, [load]).assemble(at={"s": 1.5}, rates={"s": 0.4})
        place, speed = np.asarray(q["heavy"][:2]) - (0, 1), np.asarray(v["heavy"][:2])
        np.testing.assert_allclose(np.linalg.norm(place), 1.5, rtol=1e-12)
        np.testing.assert_allclose(place @ speed / 1.5, 0.4, rtol=1e-12)


def test_what_is_shown_of_states_in_float32_has_their_digits():
    drive = m.motor(JOINTS[0], motion=lambda t, args: 0.3 + 2 * t, name="drive")
    led = m.Mechanism(BODIES, JOINTS, [drive, m.gravity((0, -9.81))])
    sol = solved(led, led.assemble(at={"k": 0.1}))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (sol.ts, sol.ys))
    rounded = dataclasses.replace(sol, ts=single[0], ys=single[1])
    for show in (
        lambda sol: led.reaction(sol, "h")[0],
        lambda sol: led.power(sol)["drive"],
        lambda sol: led.inverse_dynamics(sol, ["h"])["h"],
    ):
        np.testing.assert_allclose(show(rounded), show(sol), rtol=1e-5)
