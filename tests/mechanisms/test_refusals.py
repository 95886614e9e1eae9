"""What cannot be a mechanism is refused in a sentence that names it."""

import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m


ROD = m.Body("rod", 1.0, 0.1)
BLOCK = m.Body("block", 1.0, (0.1, 0.1, 0.1))
TURN = m.revolute(m.ground, BLOCK, (0, 0, 0), axis=(0, 0, 1))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: m.Body("rod", 0.0, 0.1), "Body 'rod' has the mass 0"),
        (lambda: m.Body("rod", 1.0, -0.1), "Body 'rod' has the inertia -0.1"),
        (lambda: m.Body("rod", 1.0, (0.1, 0.1, 0.0)), "thin rod"),
        (lambda: m.Body("rod", 1.0, (0.1, 0.1)), "`inertia` must be a number or"),
        (lambda: m.Body("ground", 1.0, 0.1), "needs a name"),
        (lambda: m.Body("rod", 1.0, 0.1, at=(0, 0, 0)), "`at` must be"),
        (lambda: m.revolute(ROD, ROD, (0, 0)), "'rod' and itself"),
        (lambda: m.prismatic(m.ground, ROD, axis=(0, 0), name="slider"), "'slider' has an axis of length 0"),
        (lambda: m.revolute(m.ground, ROD), "'ground-rod': give either `at`"),
        (lambda: m.revolute(m.ground, BLOCK, (0, 0, 0)), "needs an axis"),
        (lambda: m.spherical(m.ground, ROD, (0, 0)), "'ground' and 'rod' are planar"),
        (lambda: m.revolute(ROD, BLOCK, (0, 0)), "one is planar and one is spatial"),
        (lambda: m.universal(m.ground, BLOCK, (0, 0, 0), axes=((1, 0, 0), (1, 1, 0))), "must be perpendicular"),
        (lambda: m.distance(m.ground, ROD, ((0, 0), (0, 0))), "`length` must be a positive number"),
        (lambda: m.motor(m.revolute(m.ground, ROD, (0, 0))), "either a `torque` or a `motion`"),
        (lambda: m.spring(m.spherical(m.ground, BLOCK, (0, 0, 0)), 1.0), "no coordinate"),
        (lambda: m.spring(m.cylindrical(m.ground, BLOCK, axis=(1, 0, 0)), 1.0), "say which"),
        (lambda: m.Body("rod", 1.0, (1.0, 1.0, 5.0)), "larger than the sum of the others"),
        (lambda: m.Body("rod", np.inf, 0.1), "`mass` is not finite"),
        (lambda: m.Body("rod", 1.0, 0.1, at=(np.nan, 0)), "`at` is not finite"),
        (lambda: m.force(BLOCK, (0, 0, 1), axes="local"), "'world' or 'body', but is 'local'"),
        (lambda: m.torque(BLOCK, (0, 0, 1), axes="Body"), "'world' or 'body', but is 'Body'"),
        (lambda: m.force(BLOCK, (0, 0, 1), at=0.3), r"`at` must have the shape \(3,\)"),
        (lambda: m.friction(TURN, 1.0, smoothing=0.0), "`smoothing` must be a positive speed"),
        (lambda: m.spring(TURN, (1.0, 2.0)), "`stiffness` must be a number"),
        (lambda: m.spring(TURN, 1.0, rest=3.1), "less than half a turn"),
        (lambda: m.coupling(TURN, TURN, (0, 0.3)), "whose turns are not known"),
        (lambda: m.coupling(TURN, TURN, (0, 1, 0.5)), "whose turns are not known"),
        (lambda: m.Mechanism([ROD], loads=[m.gravity((0, 0, -9.81))]), "must have 2 components"),
        (lambda: m.Mechanism([ROD, ROD]), "Two bodies have the name 'rod'"),
        (lambda: m.Mechanism([ROD, BLOCK]), "'rod' is planar and body 'block' is spatial"),
        (lambda: m.Mechanism([BLOCK], [m.revolute(m.ground, ROD, (0, 0))]), "on the body 'rod', which is none"),
        (lambda: m.Mechanism([ROD], [m.revolute(m.ground, ROD, (0, 0))] * 2), "'ground-rod': give one"),
        (lambda: m.Mechanism([ROD]).assemble({"crank": (0, 0, 0)}), "'crank', which is no body"),
        (lambda: m.Mechanism([ROD]).assemble({"rod": (0, 0)}), "must be 3 numbers"),
        (
            lambda: m.Mechanism([ROD], [m.revolute(m.ground, ROD, (0, 0))]).assemble(at={"hinge": 1.0}),
            "no coordinate 'hinge'",
        ),
    ],
)
def test_what_is_wrong_is_named(make, said: str):
    with pytest.raises(ValueError, match=said):
        make()


def test_a_loop_that_cannot_close_is_named_with_its_gap():
    """Two rods of length 1 between points 2.5 apart."""
    one, two = m.Body("one", 1.0, 0.1, at=(0.5, 0)), m.Body("two", 1.0, 0.1, at=(1.5, 0.1))
    joints = [
        m.revolute(m.ground, one, anchors=((0, 0), (-0.5, 0)), name="left"),
        m.revolute(one, two, anchors=((0.5, 0), (-0.5, 0)), name="middle"),
        m.revolute(m.ground, two, anchors=((2.5, 0), (0.5, 0)), name="right"),
    ]
    with pytest.raises(ValueError, match=r"joint 'right' stays open by 0\.5\b"):
        m.Mechanism([one, two], joints).assemble()


def test_a_rate_that_no_joint_allows_is_refused():
    hinge = m.revolute(m.ground, ROD, (0, 0), name="hinge")
    held = m.Mechanism([ROD], [hinge], [m.motor(hinge, motion=lambda t, args: 0.0 * t)])
    with pytest.raises(ValueError, match="the values in `rates` contradict"):
        held.assemble(rates={"hinge": 1.0})


def test_without_a_joint():
    with pytest.raises(ValueError, match=r"Nothing constrains this mechanism \(bodies: rod\)"):
        m.Mechanism([ROD]).system()
    m.Mechanism([BLOCK]).system()


def test_names_of_outputs():
    mechanism = m.Mechanism([ROD], [m.revolute(m.ground, ROD, (0, 0), name="hinge")])
    q, _ = mechanism.reference
    with pytest.raises(KeyError, match="no body 'crank'"):
        q["crank"]
    with pytest.raises(ValueError, match="no joint 'pin'; there are 'hinge'"):
        mechanism.reaction(None, "pin")
    with pytest.raises(ValueError, match="no motor, spring or damper 'motor'"):
        mechanism.effort(None, "motor")
    assert np.shape(jnp.asarray(q["rod"])) == (3,)


HINGE = m.revolute(m.ground, ROD, (0, 0), name="hinge")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: m.Mechanism([HINGE], [ROD]), "the order is bodies, joints, loads"),
        (lambda: m.Mechanism([ROD], [HINGE], m.gravity((0, -9.81))), r"`loads` must be a list.*write loads=\[...\]"),
        (lambda: m.Mechanism([ROD], ["hinge"]), "'hinge' is no joint and no load"),
        (lambda: m.revolute("ground", ROD, (0, 0)), "but 'ground' is none"),
        (
            lambda: dae_jax.daesolve(m.Mechanism([ROD], [HINGE]), dae_jax.DOP853(), 0.0, 1.0, None, jnp.zeros(3)),
            r"is a Mechanism: hand over its `.system\(\)`",
        ),
    ],
)
def test_what_is_of_another_kind_is_named(make, said: str):
    with pytest.raises(TypeError, match=said):
        make()


@pytest.mark.parametrize(
    ("load", "said"),
    [
        (m.motor(HINGE, torque=lambda t, c, r, args: ROD.speed * c), "AttributeError: .Body. object has no attribute"),
        (m.motor(HINGE, torque=lambda t, c, r, args: args["T"]), r"args: None: TypeError"),
        (m.motor(HINGE, torque=lambda t: 1.0), r"TypeError: .* takes 1 positional argument"),
        (m.force(ROD, (0.0, 1.0, 0.0)), "must have the shape"),
    ],
)
def test_what_is_wrong_with_a_load_is_no_matter_of_closing(load, said: str):
    with pytest.raises(ValueError, match=said):
        m.Mechanism([ROD], [HINGE], [load]).assemble()


def test_a_state_by_name_is_told_what_a_state_is():
    system, state = m.Mechanism([ROD], [HINGE]).system(), {"rod": jnp.zeros(3)}
    with pytest.raises(ValueError, match="A state of a Mechanism is a pair of `Coordinates`"):
        dae_jax.daesolve(system, dae_jax.DOP853(), 0.0, 1.0, None, (state, state))
