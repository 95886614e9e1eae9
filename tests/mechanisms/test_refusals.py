"""What cannot be a mechanism is refused in a sentence that names it."""

import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m


ROD = m.Body("rod", 1.0, 0.1)
BLOCK = m.Body("block", 1.0, (0.1, 0.1, 0.1))
SPATIAL_ROD = m.Body("rod", 1.0, (0.1, 0.1, 0.1))
SPATIAL = "'ground-rod' was made of a spatial body 'rod', but the mechanism is planar"
TURN = m.revolute(m.ground, BLOCK, (0, 0, 0), axis=(0, 0, 1))
TWO_WAYS = m.cylindrical(m.ground, BLOCK, axis=(0, 0, 1), name="h")
HINGE = m.revolute(m.ground, ROD, (0, 0), name="hinge")
HINGED = m.Mechanism([ROD], [HINGE])
LED = m.Mechanism([ROD], [HINGE, m.motor(HINGE, motion=lambda t, args: t, name="drive")])
PAIR = ((0, 0), (1, 0))


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
        (lambda: m.force(BLOCK, (0, 0, 1), at=0.3), "`at` must be 3 numbers"),
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
        (lambda: m.Mechanism([ROD], [m.revolute(m.ground, SPATIAL_ROD, (0, 0, 0), axis=(0, 0, 1))]), SPATIAL),
        (
            lambda: m.Mechanism([ROD], [HINGE], [m.torque(SPATIAL_ROD, (0, 0, 1))]),
            "'torque on rod' was made of a spatial",
        ),
        (lambda: m.Mechanism([ROD]).assemble({"crank": (0, 0, 0)}), "'crank', which is no body"),
        (lambda: m.Mechanism([ROD]).assemble({"rod": (0, 0)}), "must be 3 numbers"),
        (
            lambda: m.Mechanism([ROD], [m.revolute(m.ground, ROD, (0, 0))]).assemble(at={"hinge": 1.0}),
            "no coordinate 'hinge'",
        ),
        # What is given twice, or would have no effect.
        (lambda: m.distance(m.ground, ROD, PAIR, anchors=PAIR), "'ground-rod': give either `at`"),
        (lambda: m.between(m.ground, ROD, PAIR, anchors=PAIR), "'ground-rod': give either `at`"),
        (
            lambda: m.point_on_curve(m.ground, ROD, (0, 0), anchor=(0, 0), curve=lambda p: p[0]),
            "or `anchor`, one of 'rod'",
        ),
        (
            lambda: m.point_on_path(m.ground, ROD, (0, 0), anchor=(0, 0), path=lambda t, args: None),
            "or `anchor`, one of",
        ),
        (lambda: m.revolute(m.ground, ROD, (0, 0), axis=(3, 4)), "bodies in the plane turn about its normal"),
        (
            lambda: m.rolling(m.ground, ROD, radius=1.0, at=(0, 0), normal=(0, 1), axis=(1, 0)),
            "in the plane turn about",
        ),
        (lambda: m.coupling(TURN, None, (0.5, 3.0, 2.0)), "a₀ is all of `coefficients`, which has 3"),
        (lambda: m.coupling(TURN, None, []), r"`coefficients` must be \(a₀, a₁, ...\), but has the shape \(0,\)"),
        (lambda: m.coupling(TURN, None, [[1.0]]), r"`coefficients` must be \(a₀, a₁, ...\), but has the shape"),
        # What is no real and finite number.
        (lambda: m.Body("rod", "a", 0.1), "`mass` must be a number, but is 'a'"),
        (lambda: m.Body("rod", None, 0.1), "`mass` must be a number, but is None"),
        (lambda: m.Body("rod", 1 + 0j, 0.1), "`mass` must be real"),
        (lambda: m.Body("rod", 1.0, [[1, 2], [3]]), "`inertia` must be a number or 3 numbers or a matrix .*, but is"),
        (lambda: m.Body("rod", 1.0, 0.1, at="ab"), "`at` must be 2 numbers, but is 'ab'"),
        (lambda: m.Body("rod", 1.0, 0.1, at=(1j, 0)), "`at` must be real"),
        (lambda: m.revolute(m.ground, ROD, "x"), "Joint 'ground-rod': `at` must be 2 numbers, but is 'x'"),
        (lambda: m.revolute(m.ground, ROD, (np.nan, 0)), "Joint 'ground-rod': `at` is not finite"),
        (lambda: m.revolute(m.ground, ROD, anchors=3), "`anchors` must be two, one of each body, but is 3"),
        (lambda: m.revolute(m.ground, BLOCK, (0, 0, 0), axis=(1j, 0, 1)), "`axis` must be real"),
        (lambda: m.universal(m.ground, BLOCK, (0, 0, 0), axes=((1, 0, 0),)), "`axes` must be two, one of each body"),
        (lambda: m.distance(m.ground, ROD, 3), "`at` must be two, one of each body, but is 3"),
        (lambda: m.distance(m.ground, ROD, PAIR, length=np.inf), "`length` is not finite: inf"),
        (lambda: m.coupling(TURN, None, (np.nan,)), "`coefficients` is not finite"),
        (lambda: m.spring(TURN, "a"), "`stiffness` must be a number, but is 'a'"),
        (lambda: m.motor(TURN, torque="1"), "`torque` must be a number, but is '1'"),
        (lambda: m.motor(TURN, torque=1 + 2j), "`torque` must be real"),
        (lambda: m.gravity("x"), "'gravity': `acceleration` must be 2 numbers or 3 numbers, but is 'x'"),
        (lambda: m.force(ROD, None), "`value` must be real numbers, but is None"),
        (lambda: HINGED.assemble({"rod": (np.nan, 0, 0)}), "`guess` for the positions of 'rod' is not finite"),
        (
            lambda: m.Mechanism([BLOCK], [TURN]).assemble({"block": np.zeros(7)}),
            "positions of 'block' has the quaternion 0, which is no orientation",
        ),
        (lambda: HINGED.assemble(at={"hinge": np.nan}), "`at` of 'hinge' is not finite"),
        (lambda: HINGED.assemble(at={"hinge": "a"}), "`at` of 'hinge' must be a number, but is 'a'"),
        (lambda: HINGED.assemble(at={"hinge": None}), "`at` of 'hinge' must be a number, but is None"),
        (lambda: HINGED.assemble(rates={"hinge": np.nan}), "`rates` of 'hinge' is not finite"),
        (lambda: HINGED.assemble(t0="x"), "`t0` must be a number, but is 'x'"),
        # Functions.
        (
            lambda: m.point_on_curve(m.ground, ROD, curve=lambda p: None),
            r"`curve\(p\)` must return numbers, but returns None",
        ),
        (
            lambda: m.point_on_curve(m.ground, ROD, curve=lambda p: p[1] > 0),
            r"`curve\(p\)` must return real floating-point",
        ),
        (
            lambda: m.point_on_curve(m.ground, ROD, curve=lambda p: np.sin(p[0])),
            r"`curve\(p\)` must be traceable by JAX",
        ),
        (lambda: m.point_on_curve(m.ground, ROD, curve=lambda p, q: p[0]), r"`curve\(p\)` must take these arguments"),
        # Names that would be those of two coordinates.
        (
            lambda: m.Mechanism(
                [BLOCK], [TWO_WAYS, m.revolute(m.ground, BLOCK, (0, 0, 0), axis=(1, 0, 0), name="h.angle")]
            ),
            "'h.angle' is the name of the angle of joint 'h' too",
        ),
        (
            lambda: m.Mechanism([BLOCK], [TWO_WAYS], [m.damper(TWO_WAYS.angle, 1.0, name="h.angle")]),
            "of the angle of joint 'h' too",
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


def test_a_name_that_is_none_is_refused_before_functions_are_asked():
    def wrong(t, c, rate, args):
        raise RuntimeError("asked")

    driven = m.Mechanism([ROD], [HINGE], [m.motor(HINGE, torque=wrong)])
    for given in ("at", "rates"):
        with pytest.raises(ValueError, match="There is no coordinate 'hinch'; there are"):
            driven.assemble(**{given: {"hinch": 0.3}})


def test_a_motor_that_contradicts_what_is_asked_for_is_named_as_one():
    drive = m.motor(HINGE, motion=lambda t, args: 0.5 + t, name="drive")
    with pytest.raises(
        ValueError, match=r"motor 'drive' is off its motion by 0\.2 (.|\n)* in `at` contradicts `motion"
    ):
        m.Mechanism([ROD], [HINGE, drive]).assemble(at={HINGE.name: 0.3})


def test_a_joint_without_a_value_at_the_guess_is_named():
    wheel = m.Body("wheel", 1.0, (0.1, 0.1, 0.1), at=(0, 0, 1))
    joint = m.rolling(m.ground, wheel, radius=1.0, at=(0, 0, 0), normal=(0, 0, 1), axis=(0, 0, 1), name="tyre")
    with pytest.raises(ValueError, match="The equations of joint 'tyre', or their derivatives, are not finite"):
        m.Mechanism([wheel], [joint]).assemble()


def test_a_motion_without_a_speed_at_the_start_is_named():
    lifted = m.motor(HINGE, motion=lambda t, args: jnp.sqrt(t), name="lift")
    with pytest.raises(ValueError, match="The equations of joint 'lift', or their derivatives, are not finite"):
        m.Mechanism([ROD], [HINGE, lifted]).assemble()


def test_what_is_no_state_has_no_rank():
    with pytest.raises(ValueError, match=r"`y0` must be the pair \(q, v\)"):
        HINGED.rank(None)


def test_without_a_joint():
    with pytest.raises(ValueError, match=r"Nothing constrains this mechanism \(bodies: rod\)"):
        m.Mechanism([ROD]).system()
    m.Mechanism([BLOCK]).system()


def test_names_of_outputs():
    mechanism = m.Mechanism([ROD], [m.revolute(m.ground, ROD, (0, 0), name="hinge")])
    q, _ = mechanism.reference
    for reads in (lambda: q["crank"], lambda: q.put("crank", q["rod"])):
        with pytest.raises(KeyError, match="no body 'crank'"):
            reads()
    with pytest.raises(ValueError, match="no joint 'pin'; there are 'hinge'"):
        mechanism.reaction(None, "pin")
    with pytest.raises(ValueError, match="no motor, spring or damper 'motor'"):
        mechanism.effort(None, "motor")
    assert np.shape(jnp.asarray(q["rod"])) == (3,)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: m.Mechanism([HINGE], [ROD]), "the order is bodies, joints, loads"),
        (lambda: m.Mechanism([ROD], [HINGE], m.gravity((0, -9.81))), r"`loads` must be a list.*write loads=\[...\]"),
        (lambda: m.Mechanism([ROD], ["hinge"]), "'hinge' is no joint and no load"),
        (lambda: m.revolute("ground", ROD, (0, 0)), "but 'ground' is none"),
        (lambda: m.distance("ground", ROD, PAIR), "but 'ground' is none"),
        (lambda: m.spring(None, 1.0), r"`joint.angle` or `between\(...\)`, but None is none"),
        (lambda: m.spring(ROD, 1.0), "What acts along a joint takes the joint"),
        (lambda: m.force(m.ground, (1, 2)), "A force acts on a body, but Ground.* is none"),
        (lambda: m.torque(HINGE, 1.0), "A torque acts on a body"),
        (
            lambda: m.point_on_curve(m.ground, ROD, curve=3),
            r"'ground-rod' must have a function `curve\(p\)`, but has 3",
        ),
        (lambda: m.point_on_path(m.ground, ROD, path=(1, 0)), r"must have a function `path\(t, args\)`"),
        (lambda: m.motor(HINGE, motion=1.0), r"'motor on hinge' must have a function `motion\(t, args\)`, but has 1.0"),
        (lambda: HINGED.assemble([1.0]), "`guess` must be coordinates by name, .*, or a pair"),
        (lambda: HINGED.assemble(np.zeros(3)), "`guess` must be coordinates by name"),
        (lambda: HINGED.assemble(({}, {}, {})), "`guess` must be coordinates by name"),
        (lambda: HINGED.assemble(at=[1.0]), "`at` must be values by name"),
        (lambda: HINGED.coordinate(HINGED.reference, "hinge"), "`sol` must be what `daesolve` returns"),
        (lambda: HINGED.rate(None, "hinge"), "`sol` must be what `daesolve` returns, but is None"),
        (lambda: HINGED.reaction(HINGED.reference, "hinge"), "`sol` must be what `daesolve` returns"),
        (lambda: HINGED.power(None), "`sol` must be what `daesolve` returns, but is None"),
        (lambda: LED.inverse_dynamics(None, ["hinge"]), "`sol` must be what `daesolve` returns, but is None"),
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
        (
            m.motor(HINGE, torque=lambda t, c, r, args: jnp.ones(2)),
            r"return a number, but what it returns has the shape \(2,\)",
        ),
        (m.motor(HINGE, motion=lambda t, args: jnp.ones(2), name="drive"), "Motor 'drive': `motion.*has the shape"),
        (m.motor(HINGE, torque=lambda t, c, r, args: 1j * c), "must return a real number, but returns a complex one"),
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
