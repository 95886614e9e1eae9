"""Efforts for a prescribed path: against Lagrange's equations in joint angles, and fed back as they are."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.interpolate import CubicSpline

import dae_jax
from dae_jax import mechanisms as m
from dae_jax.mechanisms.configuration import Coordinates


UPPER, FORE, GRAVITY = 0.8, 0.6, 9.81
MASSES = (2.0, 1.0)
INERTIAS = tuple(mass * length**2 / 12 for mass, length in zip(MASSES, (UPPER, FORE), strict=True))
TIMES = jnp.linspace(0, 1.0, 2001)
FRICTION = 0.3


def tool(t, args=None):
    """Once around an ellipse, from rest to rest."""
    turn = 2 * jnp.pi * t**3 * (10 - 15 * t + 6 * t**2)
    return jnp.stack([0.7 + 0.2 * jnp.cos(turn), 0.3 + 0.3 * jnp.sin(turn)])


def angles(t):
    """Of shoulder and elbow for the tool, elbow up: M. W. Spong, *Robot Modeling and Control*, section 1.4."""
    x, y = tool(t)
    bend = jnp.arccos((x**2 + y**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE))
    shoulder = jnp.arctan2(y, x) + jnp.arctan2(FORE * jnp.sin(bend), UPPER + FORE * jnp.cos(bend))
    return jnp.stack([shoulder, -bend])


def arm(*loads, size=1.0):
    """Two slender rods in the plane; `loads` is called with shoulder, elbow and the forearm."""
    first, second = angles(0.0)
    way = lambda angle: size * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    pin = UPPER * way(first)
    upper, fore = (
        m.Body(name, mass, size**2 * inertia, at=place, orientation=angle)
        for name, mass, inertia, place, angle in zip(
            ("upper", "fore"), MASSES, INERTIAS, (pin / 2, pin + FORE / 2 * way(first + second)), (first, first + second),
            strict=True,
        )
    )  # fmt: skip
    joints = [m.revolute(m.ground, upper, (0, 0), name="shoulder"), m.revolute(upper, fore, pin, name="elbow")]
    fixed = [m.gravity((0, -size * GRAVITY)), m.friction(joints[1], viscous=size**2 * FRICTION)]
    return m.Mechanism([upper, fore], joints, fixed + [load(*joints, fore) for load in loads])


def led(path=tool, size=1.0):
    return arm(
        lambda shoulder, elbow, fore: m.point_on_path(
            m.ground, fore, anchor=(size * FORE / 2, 0), path=path, name="tool"
        ),
        size=size,
    )


def solved(mechanism, times=TIMES):
    return dae_jax.daesolve(
        mechanism.system(), dae_jax.OrthogonalProjection(dae_jax.DOP853()), 0.0, times[-1], None, mechanism.assemble(),
        saveat=diffrax.SaveAt(ts=times), stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11),
    )  # fmt: skip


def along(mechanism, place, times, rank=None):
    """The solution with the positions `place(t)`, as if it had been solved for; `rank` where they are traced."""
    q, v = jax.jit(jax.vmap(lambda t: jax.jvp(place, (t,), (jnp.ones(()),))))(jnp.asarray(times))
    names = tuple(body.name for body in mechanism.bodies)
    y0 = mechanism.reference
    rank = rank or mechanism.rank((Coordinates(q[0], names), y0[1]))[1]
    return dae_jax.DAESolution(
        times[0], times[-1], jnp.asarray(times), (Coordinates(q, names), Coordinates(v, names)), None, {},
        dae_jax.RESULTS.successful, None, None, rank,
    )  # fmt: skip


@pytest.fixture(scope="module")
def on_path():
    mechanism = led()
    sol = solved(mechanism)
    return mechanism, sol, mechanism.inverse_dynamics(sol, ["shoulder", "elbow"])


def lagrange(t, angles=angles):
    """Torques of shoulder and elbow, d/dt ∂L/∂θ̇ − ∂L/∂θ, with friction in the elbow."""

    def lagrangian(theta, rate):
        reach = lambda theta: jnp.stack(
            [
                *(UPPER / 2 * jnp.stack([jnp.cos(theta[0]), jnp.sin(theta[0])])),
                *(UPPER * jnp.stack([jnp.cos(theta[0]), jnp.sin(theta[0])])
                  + FORE / 2 * jnp.stack([jnp.cos(theta.sum()), jnp.sin(theta.sum())])),
                theta[0],
                theta.sum(),
            ]
        )  # fmt: skip
        place, velocity = jax.jvp(reach, (theta,), (rate,))
        weights = jnp.array([MASSES[0], MASSES[0], MASSES[1], MASSES[1], *INERTIAS])
        return weights @ velocity**2 / 2 - GRAVITY * (MASSES[0] * place[1] + MASSES[1] * place[3])

    rate = lambda t: jax.jvp(angles, (t,), (jnp.ones_like(t),))[1]
    momentum = lambda t: jax.grad(lagrangian, 1)(angles(t), rate(t))
    change = jax.jvp(momentum, (t,), (jnp.ones_like(t),))[1]
    return change - jax.grad(lagrangian)(angles(t), rate(t)) + FRICTION * jnp.stack([0 * t, rate(t)[1]])


def test_torques_are_those_of_lagrange_s_equations(on_path):
    mechanism, sol, torques = on_path
    exact = np.asarray(jax.jit(jax.vmap(lagrange))(TIMES))
    found = np.stack([torques["shoulder"], torques["elbow"]], 1)
    assert np.abs(found - exact).max() < 1e-8 * np.abs(exact).max()
    turned = np.asarray(jax.vmap(angles)(TIMES))
    for k, name in enumerate(torques):
        assert np.abs(np.asarray(mechanism.coordinate(sol, name)) - (turned[:, k] - turned[0, k])).max() < 1e-9


def test_they_do_the_work_of_what_leads_and_what_the_energy_gains(on_path):
    mechanism, sol, torques = on_path
    power = mechanism.power(sol)
    work = sum(np.asarray(torques[name] * mechanism.rate(sol, name)) for name in torques)
    assert np.abs(work - power["tool"]).max() < 1e-9 * np.abs(work).max()
    total = work + np.asarray(power["friction on elbow"])
    energy = np.asarray(mechanism.energy(sol))
    half = len(TIMES) // 2 + 1
    assert abs(simpson(total[:half], x=TIMES[:half]) - (energy[half - 1] - energy[0])) < 1e-8 * np.ptp(energy)


def test_fed_forward_they_lead_the_tool_along_the_path(on_path):
    _, sol, torques = on_path
    pieces = {name: jnp.asarray(CubicSpline(TIMES, torque).c) for name, torque in torques.items()}
    width = TIMES[1] - TIMES[0]

    def of(name):
        def torque(t, c, rate, args):
            k = jnp.clip(jnp.floor(t / width).astype(int), 0, len(TIMES) - 2)
            return jnp.polyval(pieces[name][:, k], t - k * width)

        return torque

    driven = arm(
        lambda shoulder, elbow, fore: m.motor(shoulder, torque=of("shoulder")),
        lambda shoulder, elbow, fore: m.motor(elbow, torque=of("elbow")),
    )
    again = solved(driven, TIMES[::100])
    for name in ("upper", "fore"):
        assert np.abs(again.ys[0][name] - sol.ys[0][name][::100]).max() < 1e-8
    place = again.ys[0]["fore"]
    tip = place[:, :2] + FORE / 2 * jnp.stack([jnp.cos(place[:, 2]), jnp.sin(place[:, 2])], 1)
    assert np.abs(tip - jax.vmap(tool)(TIMES[::100])).max() < 1e-8


def test_motions_of_the_joints_take_the_same_torques(on_path):
    _, sol, torques = on_path
    start = angles(0.0)
    by_angles = arm(
        lambda shoulder, elbow, fore: m.motor(shoulder, motion=lambda t, args: angles(t)[0] - start[0], name="one"),
        lambda shoulder, elbow, fore: m.motor(elbow, motion=lambda t, args: angles(t)[1] - start[1], name="two"),
    )
    found = by_angles.inverse_dynamics(sol, ["shoulder", "elbow"])
    for name, torque in torques.items():
        assert np.abs(found[name] - torque).max() < 1e-8 * np.abs(torque).max()


def test_what_motors_cannot_do_is_refused(on_path):
    mechanism, sol, _ = on_path
    with pytest.raises(ValueError, match="Motors on 'elbow' cannot do what leads the mechanism"):
        mechanism.inverse_dynamics(sol, ["elbow"])
    for names in ("elbow", [], ["shoulder", "elbow", "elbow"]):
        with pytest.raises(ValueError, match="must be names of joints, each once"):
            mechanism.inverse_dynamics(sol, names)
    with pytest.raises(ValueError, match="There is no coordinate 'wrist'"):
        mechanism.inverse_dynamics(sol, ["wrist"])
    with pytest.raises(ValueError, match="Nothing leads the mechanism"):
        arm().inverse_dynamics(sol, ["elbow"])


def test_two_motors_of_one_joint_take_half_each(on_path):
    mechanism, sol, torques = on_path
    shared = mechanism.inverse_dynamics(sol, ["shoulder", "elbow", "friction on elbow"])
    np.testing.assert_allclose(shared["shoulder"], torques["shoulder"], atol=1e-10)
    for name in ("elbow", "friction on elbow"):
        np.testing.assert_allclose(shared[name], torques["elbow"] / 2, atol=1e-10)


def test_a_turn_in_space_about_a_tilted_axis():
    """A rod on a hinge that is not level, θ = t³ in a given motion: J θ̈ and the weight about the axis."""
    axis, arm = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.5, 0.0])
    rod = m.Body("rod", 2.0, (0.1, 0.2, 0.3), at=arm)
    hinge = m.revolute(m.ground, rod, (0, 0, 0), axis=axis, name="hinge")
    motor = m.motor(hinge, motion=lambda t, args: t**3, name="motor")
    mechanism = m.Mechanism([rod], [hinge], [m.gravity((0, 0, -GRAVITY)), motor])

    def turned(t):
        c, s = jnp.cos(t**3), jnp.sin(t**3)
        place = c * arm + s * jnp.cross(axis, arm) + (1 - c) * (axis @ arm) * axis
        return jnp.concatenate([place, jnp.cos(t**3 / 2)[None], jnp.sin(t**3 / 2) * axis])[None]

    times = jnp.linspace(0, 1, 11)
    sol = along(mechanism, turned, times)
    torque = mechanism.inverse_dynamics(sol, ["hinge"])["hinge"]
    inertia = axis @ np.diag([0.1, 0.2, 0.3]) @ axis + 2.0 * 0.5**2
    weight = np.cross(np.asarray(sol.ys[0]["rod"])[:, :3], [0, 0, -2.0 * GRAVITY]) @ axis
    np.testing.assert_allclose(torque, inertia * 6 * np.asarray(times) - weight, atol=1e-8)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_have_derivatives_where_constraints_are_perpendicular(mode):
    """A rod on a hinge, θ = a t³: level, its constraints have singular values that are equal. By its mass, a and its inertia."""
    times = jnp.linspace(0, 1, 6)

    def turned(t, a):
        return jnp.stack([0.5 * jnp.cos(a * t**3), 0.5 * jnp.sin(a * t**3), a * t**3])[None]

    def found(x):
        mass, a, inertia = x
        rod = m.Body("rod", mass, inertia, at=(0.5, 0.0))
        hinge = m.revolute(m.ground, rod, (0, 0), name="hinge")
        motor = m.motor(hinge, motion=lambda t, args: a * t**3, name="motor")
        mechanism = m.Mechanism([rod], [hinge], [m.gravity((0, -GRAVITY)), motor])
        return mechanism.inverse_dynamics(along(mechanism, lambda t: turned(t, a), times, rank=3), ["hinge"])["hinge"]

    def exact(x):
        mass, a, inertia = x
        return (inertia + mass / 4) * 6 * a * times + mass * GRAVITY / 2 * jnp.cos(a * times**3)

    x = jnp.array([2.0, 1.3, 0.4])
    np.testing.assert_allclose(jax.jit(mode(found))(x), jax.jacfwd(exact)(x), rtol=1e-10, atol=1e-10)


def test_a_path_in_the_axes_of_a_body_that_moves():
    """A slider that is led along a rod which turns by itself: the rod's end and the path's add up."""
    rod = m.Body("rod", 1.0, 0.2, at=(0.0, 0.0), spin=1.0)
    slider = m.Body("slider", 0.5, 0.1, at=(0.5, 0.0))
    joints = [
        m.revolute(m.ground, rod, (0, 0), name="hinge"),
        m.prismatic(rod, slider, (0, 0), axis=(1, 0), name="guide"),
    ]
    motor = m.motor(joints[0], motion=lambda t, args: 2 * t, name="turn")
    place = lambda t, args: jnp.stack([0.5 + 0.1 * t**3, 0 * t])
    # The guide holds the point across the rod already: the path's second equation depends on it.
    led = m.point_on_path(rod, slider, path=place, name="along")
    mechanism = m.Mechanism([rod, slider], joints, [motor, led])

    def moved(t):
        radius = 0.5 + 0.1 * t**3
        return jnp.stack(
            [jnp.stack([0 * t, 0 * t, 2 * t]), jnp.stack([radius * jnp.cos(2 * t), radius * jnp.sin(2 * t), 2 * t])]
        )

    sol = along(mechanism, moved, jnp.linspace(0, 1, 11))
    force = mechanism.inverse_dynamics(sol, ["hinge", "guide"])
    t = np.asarray(sol.ts)
    radius, speed, change = 0.5 + 0.1 * t**3, 0.3 * t**2, 0.6 * t
    np.testing.assert_allclose(force["guide"], 0.5 * (change - 4 * radius), atol=1e-9)
    np.testing.assert_allclose(force["hinge"], 0.5 * 2 * radius * speed * 2, atol=1e-9)


def test_a_path_of_another_shape_is_refused():
    body = m.Body("body", 1.0, 1.0)
    led = m.point_on_path(m.ground, body, path=lambda t, args: t)
    with pytest.raises(ValueError, match=r"`path\(t, args\)` must have the shape \(2,\), but has \(\)"):
        m.Mechanism([body], [led]).assemble()


# A load that motors reach by way of the dynamics only


def crane(rail_force, winch_force, *more):
    trolley, load = m.Body("trolley", 1.0, 1.0, at=(0, 0)), m.Body("load", 1.0, 1.0, at=(0, -2.0))
    rail = m.prismatic(m.ground, trolley, axis=(1, 0), name="rail")
    rope = m.between(trolley, load, ((0, 0), (0, -2.0)))
    hold = m.motor(m.revolute(trolley, load, (0, 0)).angle, motion=lambda t, args: 0.0, name="upright")
    motors = [m.motor(rail, torque=rail_force, name="drive"), m.motor(rope, torque=winch_force, name="winch")]
    return m.Mechanism(
        [trolley, load], [rail, hold, *(joint(load) for joint in more)], [m.gravity((0, -GRAVITY)), *motors]
    )


def test_efforts_of_a_crane_are_unknowns_of_a_dae_of_index_five():
    """The load is led at depth 2 by 3 t⁵/5, and the trolley stays, as no force is on it."""
    path = lambda t: jnp.stack([0.6 * t**5, -2.0 + 0 * t])
    given = crane(lambda t, c, rate, u: u["drive"], lambda t, c, rate, u: u["winch"])

    def residual(t, y, yd, args):
        q, v, lam, u = y
        _, pull = jax.vjp(lambda q: given.constraint(t, q, u), q)
        forces = given.force(t, q, v, u).values - pull(lam)[0].values
        balance = given.mass(q) * yd[1].values.ravel() - forces.ravel()
        servo = q["load"][:2] - path(t)
        return yd[0].values - v.values, balance, given.constraint(t, q, u), servo

    q, v = given.reference
    guess = (q, v, jnp.zeros(3), {"drive": jnp.zeros(()), "winch": jnp.asarray(-GRAVITY)})
    structure = dae_jax.analyse(dae_jax.ImplicitDAE(residual), 0.0, guess)
    assert structure.index == 5
    assert structure.degrees_of_freedom == 0
    led = crane(
        lambda *_: 0.0,
        lambda *_: 0.0,
        lambda load: m.point_on_path(m.ground, load, path=lambda t, args: path(t), name="path"),
    )

    def moved(t):
        return jnp.stack([jnp.zeros(3), jnp.append(path(t), 0.0)])

    with pytest.raises(ValueError, match="unknowns of an `ImplicitDAE`"):
        led.inverse_dynamics(along(led, moved, jnp.linspace(0, 1, 5)), ["drive", "winch"])


# What would be a wrong number


def rods(t, of=angles, size=1.0):
    """Both rods at the angles `of`."""
    first, second = of(t)
    way = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    pin = UPPER * way(first)
    places = (pin / 2, pin + FORE / 2 * way(first + second))
    return jnp.stack(
        [jnp.append(size * place, angle) for place, angle in zip(places, (first, first + second), strict=True)]
    )


def test_states_that_are_off_the_path_are_refused(on_path):
    mechanism, *_ = on_path
    times = jnp.linspace(0, 1, 5)
    slower = along(mechanism, lambda t: rods(0.99 * t), times)
    with pytest.raises(ValueError, match=r"at t = 0.25 it is off the equations: by up to 0.\d+ in place"):
        mechanism.inverse_dynamics(slower, ["shoulder", "elbow"])
    q, v = along(mechanism, rods, times).ys
    late = dataclasses.replace(slower, ys=(q, dataclasses.replace(v, values=1.01 * v.values)))
    with pytest.raises(ValueError, match=r"it is off the equations: by up to .*e-.* in place .* and 0.0.* in velocity"):
        mechanism.inverse_dynamics(late, ["shoulder", "elbow"])
    batch = jax.jit(lambda sol: mechanism.inverse_dynamics(sol, ["shoulder", "elbow"]))(slower)
    np.testing.assert_array_equal(np.isnan(batch["elbow"]), [False, True, True, True, False])


def test_a_singular_configuration_is_refused():
    """An arm that is led by its tip swings through where it is stretched out, at t = 1/2."""
    through = lambda t: jnp.stack([0.3 + 0.5 * t, t - 0.5])
    way = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    mechanism = led(lambda t, args: rods(t, through)[1, :2] + FORE / 2 * way(through(t).sum()))
    times = [0.2, 0.5 + 1e-7, 0.8]
    with pytest.raises(ValueError, match=r"At t = 0.5 efforts are not determined: .*a singular configuration"):
        mechanism.inverse_dynamics(along(mechanism, lambda t: rods(t, through), times), ["shoulder", "elbow"])


def test_units_do_not_count():
    """Micrometres in metres, where torques are small beside forces: what one motor leaves undone still shows."""
    tiny = 1e-6
    mechanism = led(lambda t, args: tiny * tool(t), size=tiny)
    sol = along(mechanism, lambda t: rods(t, size=tiny), jnp.linspace(0, 1, 5))
    with pytest.raises(ValueError, match="Motors on 'shoulder' cannot do"):
        mechanism.inverse_dynamics(sol, ["shoulder"])


def test_nothing_is_asked_of_what_is_in_balance():
    """A rod at rest on its centre, and held there: 0, and no refusal of round-off."""
    rod = m.Body("rod", 1.0, 0.1, at=(0.3, 0.4), orientation=0.7)
    hinge = m.revolute(m.ground, rod, (0.3, 0.4), name="hinge")
    slide = m.Body("slide", 1.0, 0.1, at=(0.1, 0.7))
    rail = m.prismatic(m.ground, slide, axis=(1, 0), name="rail")
    hold = m.motor(hinge, motion=lambda t, args: 0 * t)
    mechanism = m.Mechanism([rod, slide], [hinge, rail, hold], [m.gravity((0, -GRAVITY))])
    still = along(mechanism, lambda t: mechanism.reference[0].values + 0 * t, jnp.zeros(3))
    np.testing.assert_allclose(mechanism.inverse_dynamics(still, ["rail"])["rail"], 0, atol=1e-12)


SWING = 1.0


def swing(t, args):
    return SWING * t**2


def test_a_changed_global_is_seen(monkeypatch):
    hinge = m.revolute(m.ground, wheel := m.Body("wheel", 1.0, 0.5), (0, 0), name="hinge")
    mechanism = m.Mechanism([wheel], [hinge, m.motor(hinge, motion=swing, name="drive")])
    for value in (1.0, 2.0):
        monkeypatch.setitem(globals(), "SWING", value)
        sol = solved(mechanism, jnp.array([0.5, 1.0]))
        torque = mechanism.inverse_dynamics(sol, ["hinge"])["hinge"]
        np.testing.assert_allclose(torque, value, rtol=1e-6)
        np.testing.assert_allclose(mechanism.effort(sol, "drive"), value, rtol=1e-6)
