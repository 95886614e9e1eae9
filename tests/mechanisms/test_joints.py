"""Each joint takes as many degrees of freedom as it has equations, and is satisfied by the motions that it leaves free."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dae_jax
from dae_jax import mechanisms as m


POINT, AXIS, SIDE = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, 2.0]) / 3, np.array([2.0, 1.0, -2.0]) / 3


def turned(r: Rotation) -> np.ndarray:
    return np.roll(r.as_quat(), 1)


A = m.Body("a", 1.0, (1.0, 1.2, 1.4), at=(0.1, 0.2, 0.3), orientation=(1.0, 0.2, -0.3, 0.4))
B = m.Body("b", 2.0, (1.0, 1.2, 1.4), at=(-0.4, 0.6, 0.2), orientation=(0.5, -0.7, 0.1, 0.4))
ANY = Rotation.from_rotvec([0.3, -0.5, 0.8])
ABOUT = Rotation.from_rotvec(0.7 * AXIS)
# The joint, how many equations it has, and a motion that it leaves free: a turn about POINT and a displacement.
SPATIAL = {
    "revolute": (m.revolute(A, B, POINT, axis=AXIS), 5, ABOUT, 0 * AXIS),
    "prismatic": (m.prismatic(A, B, POINT, axis=AXIS), 5, Rotation.identity(), 0.4 * AXIS),
    "cylindrical": (m.cylindrical(A, B, POINT, axis=AXIS), 4, ABOUT, 0.4 * AXIS),
    "spherical": (m.spherical(A, B, POINT), 3, ANY, 0 * AXIS),
    "universal": (
        m.universal(A, B, POINT, axes=(AXIS, SIDE)),
        4,
        Rotation.from_rotvec(0.4 * AXIS) * Rotation.from_rotvec(0.9 * SIDE),
        0 * AXIS,
    ),
    "planar": (m.planar(A, B, POINT, normal=AXIS), 3, ABOUT, 0.4 * SIDE),
    "fixed": (m.fixed(A, B, POINT), 6, Rotation.identity(), 0 * AXIS),
    "distance": (m.distance(A, B, (POINT - 0.5 * AXIS, POINT)), 1, ANY, 0 * AXIS),
}


def of(mechanism: m.Mechanism, **rows: np.ndarray) -> m.Coordinates:
    q, _ = mechanism.reference
    for name, row in rows.items():
        q = q.put(name, jnp.asarray(row))
    return q


@pytest.mark.parametrize("joint", SPATIAL)
def test_a_joint_in_space(joint: str):
    made, count, turn, shift = SPATIAL[joint]
    mechanism = m.Mechanism([A, B], [made])
    q, v = mechanism.reference
    rows, _ = mechanism.rows()[made.name]
    assert len(rows) == count
    assert mechanism.rank((q, v))[0] == count + 2
    place = POINT + shift + turn.apply(np.asarray(B.at) - POINT)
    orientation = turned(turn * Rotation.from_quat(np.roll(np.asarray(B.orientation), -1)))
    moved = [np.concatenate([A.at, A.orientation]), np.concatenate([place, orientation])]
    # All of it moved as one body besides.
    far = Rotation.from_rotvec([0.2, 0.9, -0.4])
    for k, row in enumerate(moved):
        whole = turned(far * Rotation.from_quat(np.roll(row[3:], -1)))
        moved[k] = np.concatenate([far.apply(row[:3]) + np.arange(1.0, 4.0), whole])
    assert np.abs(mechanism.constraint(0.0, of(mechanism, a=moved[0], b=moved[1]), None)).max() < 1e-14
    # And what it does not leave free, it sees.
    pushed = of(mechanism, b=np.concatenate([np.asarray(B.at) + np.array([0.1, 0.2, -0.3]), np.asarray(B.orientation)]))
    assert np.abs(mechanism.constraint(0.0, pushed, None)).max() > 1e-2


def test_coordinates_are_the_angle_and_the_displacement():
    made = m.cylindrical(A, B, POINT, axis=AXIS, name="c")
    mechanism = m.Mechanism([A, B], [made], [m.spring(made.angle, 1.0), m.damper(made.displacement, 1.0)])
    place = POINT + 0.4 * AXIS + ABOUT.apply(np.asarray(B.at) - POINT)
    row = np.concatenate([place, turned(ABOUT * Rotation.from_quat(np.roll(np.asarray(B.orientation), -1)))])
    at = mechanism.configuration(of(mechanism, b=row))
    assert float(made.angle(at)) == pytest.approx(0.7)
    assert float(made.displacement(at)) == pytest.approx(0.4)


PA, PB = m.Body("a", 1.0, 0.1, at=(0.2, 0.1), orientation=0.4), m.Body("b", 1.0, 0.1, at=(1.0, 0.5), orientation=5.0)


@pytest.mark.parametrize(
    ("joint", "count", "moved"),
    [
        (m.revolute(PA, PB, (0.6, 0.3)), 2, None),
        (m.prismatic(PA, PB, axis=(3, 4)), 2, (1.0 + 0.6, 0.5 + 0.8, 5.0)),
        (m.fixed(PA, PB), 3, (1.0, 0.5, 5.0)),
        (m.distance(PA, PB, ((0.2, 0.1), (1.0, 0.5))), 1, (0.2 + 0.4, 0.1 + 0.8, 2.0)),
    ],
    ids=["revolute", "prismatic", "fixed", "distance"],
)
def test_a_joint_in_the_plane(joint, count, moved):
    mechanism = m.Mechanism([PA, PB], [joint])
    assert mechanism.rank(mechanism.reference) == (count, count)
    if moved is not None:
        assert np.abs(mechanism.constraint(0.0, of(mechanism, b=np.array(moved)), None)).max() < 1e-14


def test_what_leads_may_read_the_args():
    hinge = m.revolute(m.ground, crank := m.Body("crank", 1.0, 0.2, at=(0.5, 0.0)), (0.0, 0.0))
    motor = m.motor(hinge, motion=lambda t, args: args["rate"] * t)
    path = lambda t, args: 0.5 * jnp.stack([jnp.cos(args["rate"] * t), jnp.sin(args["rate"] * t)])
    led = m.point_on_path(m.ground, crank, (0.5, 0.0), path=path)
    for joints in ([hinge, motor], [led]):
        mechanism, args = m.Mechanism([crank], joints), {"rate": 3.0}
        y0 = mechanism.assemble(t0=0.1, args=args)
        np.testing.assert_allclose(y0[0]["crank"][:2], [0.5 * np.cos(0.3), 0.5 * np.sin(0.3)], atol=1e-9)
        np.testing.assert_allclose(y0[1]["crank"][:2], [-1.5 * np.sin(0.3), 1.5 * np.cos(0.3)], atol=1e-8)


def test_a_point_on_a_curve():
    circle = m.point_on_curve(m.ground, PB, anchor=(0.1, 0.0), curve=lambda p: p @ p - 4.0)
    mechanism = m.Mechanism([PB], [circle])
    assert mechanism.rank(mechanism.reference) == (1, 1)
    assert np.abs(mechanism.constraint(0.0, of(mechanism, b=np.array([1.9, 0.0, 0.0])), None)).max() < 1e-14


@pytest.mark.parametrize("disc", [True, False])
def test_a_wheel_rolls(disc: bool):
    """Straight on, at v = ω R: neither the contact nor its velocity is off; and at any other speed it is."""
    wheel = m.Body("wheel", 1.0, (0.1, 0.2, 0.1), at=(0, 0, 0.5), velocity=(1.0, 0, 0), spin=(0, 2.0, 0))
    axis = (0, 1, 0) if disc else None
    rolling = m.rolling(m.ground, wheel, radius=0.5, at=(0, 0, 0), normal=(0, 0, 1), axis=axis)
    mechanism = m.Mechanism([wheel], [rolling])
    q, v = mechanism.reference
    assert mechanism.rank((q, v)) == (2, 4)
    assert np.abs(mechanism.constraint(0.0, q, None)).max() < 1e-15
    assert np.abs(mechanism.nonholonomic(0.0, q, v, None)).max() < 1e-15
    faster = m.Coordinates(1.1 * v.values.at[:, 3:].set(0), v.names)
    assert np.abs(mechanism.nonholonomic(0.0, q, faster, None)).max() > 0.1


def test_a_wheel_rolls_in_the_plane():
    wheel = m.Body("wheel", 1.0, 0.1, at=(0, 0.5), velocity=(1.0, 0), spin=-2.0)
    mechanism = m.Mechanism([wheel], [m.rolling(m.ground, wheel, radius=0.5, at=(0, 0), normal=(0, 1))])
    q, v = mechanism.reference
    assert mechanism.rank((q, v)) == (1, 2)
    assert np.abs(mechanism.nonholonomic(0.0, q, v, None)).max() < 1e-15


def test_a_gear_couples_two_angles():
    one, two = m.revolute(m.ground, PA, (0.2, 0.1), name="one"), m.revolute(m.ground, PB, (1.0, 0.5), name="two")
    mechanism = m.Mechanism([PA, PB], [one, two, m.coupling(one, two, (0.0, -2.0), name="gear")])
    q, v = mechanism.assemble(at={"two": 0.3}, rates={"two": 1.0})
    assert float(q["a"][2]) == pytest.approx(0.4 - 0.6)
    assert float(v["a"][2]) == pytest.approx(-2.0)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ratio", [2.0, 0.5])
def test_the_reaction_of_a_gear_is_on_the_second_body_of_its_first_joint(dimension: int, ratio: float):
    """J α − T of the wheel that a motor drives by T, whichever of the two angles the equation is solved for."""
    axis, inertia = (None, (0.3, 0.7)) if dimension == 2 else ((0, 0, 1), ((0.3,) * 3, (0.7,) * 3))
    places = [(0, 0, 0)[:dimension], (3, 0, 0)[:dimension]]
    wheels = [m.Body(name, 1.0, j, at=at) for name, j, at in zip("ab", inertia, places, strict=True)]
    one, two = (m.revolute(m.ground, x, at, axis=axis, name=x.name) for x, at in zip(wheels, places, strict=True))
    gear, motor = m.coupling(one, two, (0.0, ratio), name="gear"), m.motor(one, torque=2.0)
    mechanism = m.Mechanism(wheels, [one, two, gear], [motor])
    solver = dae_jax.OrthogonalProjection(dae_jax.DOP853())
    sol = dae_jax.daesolve(mechanism.system(), solver, 0.0, 0.1, None, mechanism.assemble())
    force, moment = mechanism.reaction(sol, "gear")
    acceleration = 2.0 * ratio**2 / (0.3 * ratio**2 + 0.7)
    np.testing.assert_allclose(np.ravel(moment[-1])[-1], 0.3 * acceleration - 2.0, rtol=1e-9)
    np.testing.assert_allclose(force[-1], 0, atol=1e-12)


def test_lagrange_s_equations_of_a_body_are_those_of_its_kinetic_energy():
    """∂T/∂q − Ṁ v against automatic differentiation of T, off the constraint too."""
    mechanism = m.Mechanism([A])
    key = jax.random.split(jax.random.key(1))
    q, v = (m.Coordinates(jax.random.normal(k, (1, 7)), ("a",)) for k in key)

    def momentum(q: m.Coordinates):
        return jnp.einsum("bij,bj->bi", mechanism.mass(q), v.values)

    slope = jax.grad(lambda q: jnp.sum(momentum(q) * v.values) / 2)(q).values
    change = jax.jvp(momentum, (q,), (v,))[1]
    assert np.allclose(mechanism.force(0.0, q, v, None).values, slope - change, rtol=1e-12)
