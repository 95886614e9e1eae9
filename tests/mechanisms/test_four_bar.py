"""A four-bar linkage in the plane: closed forms, power, gradients, batches; and the same linkage in space."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import simpson

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.equations.mechanical import MechanicalODE


CRANK, COUPLER, ROCKER, BASE = 1.0, 3.0, 2.5, 3.2
SPEED = 2.0
TIMES = jnp.linspace(0, 2.0, 201)
TIGHT = diffrax.PIDController(rtol=1e-11, atol=1e-11)


def closed_form(theta, crank=CRANK):
    """The rocker's angle, open branch, for the crank's: Norton, *Design of Machinery*, section 4.5."""
    x, y = BASE - crank * np.cos(theta), -crank * np.sin(theta)
    diagonal = np.hypot(x, y)
    inner = np.arccos((ROCKER**2 + diagonal**2 - COUPLER**2) / (2 * ROCKER * diagonal))
    return np.arctan2(-y, -x) - inner


def linkage(crank=CRANK, spatial: bool = False, motor: bool = True) -> m.Mechanism:
    """Rods along their lines at θ = 0.9, anchors in their own axes."""
    theta = 0.9
    rocker = closed_form(theta)
    pin = crank * jnp.array([np.cos(theta), np.sin(theta)])
    end = jnp.array([BASE, 0.0]) + ROCKER * jnp.array([np.cos(rocker), np.sin(rocker)])
    lift = (lambda p: jnp.append(jnp.asarray(p, float), 0.0)) if spatial else jnp.asarray

    def rod(name: str, mass: float, start, stop) -> m.Body:
        length = jnp.sqrt(jnp.sum((stop - start) ** 2))
        inertia = mass * length**2 / 12
        angle = jnp.arctan2(*(stop - start)[::-1])
        turn = jnp.stack([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)]) if spatial else angle
        moments = jnp.stack([0.7 * inertia, 0.4 * inertia, inertia]) if spatial else inertia
        return m.Body(name, mass, moments, at=lift((start + stop) / 2), orientation=turn)

    zero, base = jnp.zeros(2), jnp.array([BASE, 0.0])
    one, two, three = rod("crank", 1.0, zero, pin), rod("coupler", 2.0, pin, end), rod("rocker", 1.5, base, end)
    axis = {"axis": (0, 0, 1)} if spatial else {}
    hinge = m.revolute(m.ground, one, lift(zero), name="hinge", **axis)
    joints = [
        hinge,
        m.revolute(one, two, lift(pin), name="pin", **axis),
        m.revolute(two, three, lift(end), name="end", **axis),
        m.revolute(m.ground, three, lift(base), name="pivot", **axis),
    ]
    loads = [m.gravity(lift((0.0, -9.81)))]
    if motor:
        loads.append(m.motor(hinge, motion=lambda t, args: SPEED * t, name="motor"))
    return m.Mechanism([one, two, three], joints, loads)


def solved(mechanism: m.Mechanism, y0, times=TIMES):
    solver = dae_jax.OrthogonalProjection(dae_jax.DOP853())
    saveat = diffrax.SaveAt(ts=times)
    return dae_jax.daesolve(
        mechanism.system(), solver, 0.0, times[-1], None, y0, saveat=saveat, stepsize_controller=TIGHT
    )


@pytest.fixture(scope="module")
def driven():
    mechanism = linkage()
    return mechanism, solved(mechanism, mechanism.assemble())


def test_angle_and_speed_of_the_rocker_are_those_of_the_closed_form(driven):
    mechanism, sol = driven
    theta = 0.9 + SPEED * np.asarray(sol.ts)
    exact = np.unwrap(closed_form(theta))
    assert np.abs(np.asarray(mechanism.coordinate(sol, "pivot")) - (exact - exact[0])).max() < 1e-9
    # The speed by the loop's velocity equation: that of the coupler's end along the coupler is one.
    rocker = np.stack([np.cos(exact), np.sin(exact)])
    pin = CRANK * np.stack([np.cos(theta), np.sin(theta)])
    coupler = np.array([[BASE], [0.0]]) + ROCKER * rocker - pin
    speed = SPEED * (np.stack([-pin[1], pin[0]]) * coupler).sum(0)
    speed = speed / (ROCKER * np.stack([-rocker[1], rocker[0]]) * coupler).sum(0)
    assert np.abs(np.asarray(mechanism.rate(sol, "pivot")) - speed).max() < 1e-9


def test_what_the_motor_puts_in_is_what_the_energy_gains(driven):
    mechanism, sol = driven
    energy, power = np.asarray(mechanism.energy(sol)), np.asarray(mechanism.power(sol)["motor"])
    assert abs(simpson(power, x=np.asarray(sol.ts)) - (energy[-1] - energy[0])) < 1e-5 * np.ptp(energy)
    assert np.allclose(power, SPEED * np.asarray(mechanism.effort(sol, "motor")))


def test_forces_on_the_rocker_balance_its_momentum(driven):
    mechanism, sol = driven
    at_end, _ = mechanism.reaction(sol, "end")
    at_pivot, moment = mechanism.reaction(sol, "pivot")
    velocity = np.asarray(sol.ys[1]["rocker"])[:, :2]
    acceleration = np.gradient(velocity, np.asarray(sol.ts), axis=0, edge_order=2)
    asked = 1.5 * (acceleration + np.array([0, 9.81]))
    assert np.abs(np.asarray(at_end + at_pivot) - asked)[2:-2].max() < 1e-2 * np.abs(asked).max()
    assert np.abs(moment).max() < 1e-9
    in_body, _ = mechanism.reaction(sol, "pivot", axes="body")
    assert np.allclose(np.linalg.norm(in_body, axis=1), np.linalg.norm(at_pivot, axis=1))


def pull(crank):
    """The pivot's force a second after a start from rest."""
    mechanism = linkage(crank, motor=False)
    sol = solved(mechanism, mechanism.reference, jnp.linspace(0, 0.5, 2))
    return mechanism.reaction(sol, "pivot")[0][-1, 0]


def test_the_gradient_of_a_reaction_by_a_length_is_the_difference_quotient():
    h = 1e-5
    difference = (pull(jnp.asarray(CRANK + h)) - pull(jnp.asarray(CRANK - h))) / (2 * h)
    assert jax.grad(pull)(jnp.asarray(CRANK)) == pytest.approx(float(difference), rel=1e-6)


def test_a_batch_of_designs_is_what_they_are_one_by_one():
    designs = jnp.linspace(0.9, 1.1, 3)
    one_by_one = jnp.stack([pull(x) for x in designs])
    assert np.allclose(jax.vmap(pull)(designs), one_by_one, rtol=1e-9)


def test_the_linkage_in_space_moves_as_that_in_the_plane():
    """Accelerations and the forces of a joint at a moving state, where 3 of 23 equations in space are redundant."""
    planar, spatial = linkage(motor=False), linkage(spatial=True, motor=False)
    found = []
    for mechanism in (planar, spatial):
        y0 = mechanism.assemble(rates={"hinge": 2.0})
        rank = mechanism.rank(y0)
        system = mechanism.system(rank=None if mechanism is planar else rank)
        ode = MechanicalODE.of(system, 0.0, y0, None, system.rank)
        _, acceleration = jax.jit(lambda y, ode=ode: ode.field(0.0, y))(ode.encode(y0))
        found.append((rank, ode.decode(0.0, (acceleration, acceleration))[0], y0[1]))
    assert found[0][0] == (8, 8)
    assert found[1][0] == (20, 20)
    for name in ("crank", "coupler", "rocker"):
        for plane, space in zip(found[0][1:], found[1][1:], strict=True):
            assert np.allclose(plane[name][:2], space[name][:2], atol=1e-9)


def test_a_guess_that_is_off_is_brought_together():
    mechanism = linkage(motor=False)
    q, _ = mechanism.assemble({"crank": (0.3, 0.6, 1.2)}, at={"hinge": 0.2})
    assert float(q["crank"][2]) == pytest.approx(0.9 + 0.2)
    assert np.abs(mechanism.constraint(0.0, q, None)).max() < 1e-12
