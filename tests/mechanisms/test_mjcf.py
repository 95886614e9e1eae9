"""MJCF files: what is read of them moves as MuJoCo moves it, better the smaller its step."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax import mechanisms as m


mujoco = pytest.importorskip("mujoco", reason="MuJoCo, the extra [mjcf], is not installed")

PENDULUM = """<mujoco><option gravity="0 0 -9.81" integrator="RK4"><flag contact="disable"/></option><worldbody>
<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0.2" damping="0.1" stiffness="2" springref="10"/>
<geom type="capsule" size=".05" fromto="0 0 0 .5 .1 0" mass="1"/>
<body name="tip" pos=".5 0 .1"><geom size=".05" mass=".3"/></body></body></worldbody></mujoco>"""

LOOP = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
<body name="left"><joint name="a" axis="0 1 0" range="-90 90" limited="true"/>
<geom type="capsule" size=".05" fromto="0 0 0 0 0 1" mass="1"/>
<body name="top" pos="0 0 1"><joint name="b" axis="0 1 0"/><geom type="capsule" size=".05" fromto="0 0 0 2 0 0" mass="1"/>
</body></body>
<body name="right" pos="2 0 0"><joint name="c" axis="0 1 0"/><geom type="capsule" size=".05" fromto="0 0 0 0 0 1" mass="1"/></body>
</worldbody><equality><connect name="pin" body1="top" body2="right" anchor="2 0 0"/>
<joint name="gear" joint1="a" joint2="c"/></equality><actuator><motor name="drive" joint="a"/></actuator></mujoco>"""


def test_a_pendulum_moves_as_mujoco_moves_it():
    mechanism = m.read_mjcf(PENDULUM)
    times = np.linspace(0, 1, 11)
    sol = dae_jax.daesolve(
        mechanism.system(),
        dae_jax.OrthogonalProjection(dae_jax.DOP853()),
        0.0,
        1.0,
        None,
        mechanism.assemble(),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )
    ours, off = np.asarray(mechanism.coordinate(sol, "hinge")), []
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    for step in (1e-2, 5e-3, 2.5e-3):
        model.opt.timestep = step
        data, theirs = mujoco.MjData(model), [0.0]
        for _ in times[1:]:
            mujoco.mj_step(model, data, nstep=round(0.1 / step))
            theirs.append(float(data.qpos[0]))
        off.append(np.abs(ours - theirs).max())
    assert off[2] < 1e-7
    assert off[0] / off[1] > 8
    assert off[1] / off[2] > 8


def test_a_loop_is_closed_and_what_is_left_out_is_named():
    with pytest.warns(UserWarning, match=r"limits of 'a'; contacts of .*; actuators 'drive'"):
        mechanism = m.read_mjcf(LOOP)
    assert [body.name for body in mechanism.bodies] == ["left", "top", "right"]
    y0 = mechanism.assemble(rates={"c": 1.0})
    # A parallelogram: one degree of freedom, of 21 coordinates.
    assert mechanism.rank(y0)[0] == 20
    at = mechanism.configuration(*y0)
    rates = {joint.name: joint.angle.with_rate(at)[1] for joint in mechanism.joints if joint.name in "abc"}
    assert np.allclose([rates["a"], rates["b"], rates["c"]], [1.0, -1.0, 1.0])


def test_keyframes_are_named():
    """The reference configuration is that of `qpos0`: a pose of the file that is none was passed over."""
    keys = '<keyframe><key name="raised" qpos="0.7"/><key qpos="-0.1"/></keyframe></mujoco>'
    with pytest.warns(UserWarning, match=r"Left out of the mechanism: keyframes 'raised', 'key 1'\.$"):
        m.read_mjcf(PENDULUM.replace("</mujoco>", keys))


def test_all_that_is_not_supported_is_listed():
    model = """<mujoco><worldbody><body name="a"><joint name="h" armature="0.1"/><joint name="s" type="slide"/>
    <joint name="r"/><geom size=".1"/></body><body name="b"><joint name="g" frictionloss="1" armature="2"/><geom size=".1"/></body>
    </worldbody><tendon><fixed name="t"><joint joint="g" coef="1"/></fixed></tendon></mujoco>"""
    with pytest.raises(ValueError, match="1 tendons") as refusal:
        m.read_mjcf(model)
    for part in ("'h', 's', 'r' of body 'a' together", "armature of joint 'g'", "frictionloss of joint 'g'"):
        assert part in str(refusal.value)


GEOM = '<geom size=".1" mass="1" pos=".5 0 0"/>'


@pytest.mark.parametrize(
    ("bodies", "said"),
    [
        (f'<body name="a">{GEOM}</body>', "nothing moves"),
        (f'<body mocap="true">{GEOM}</body><body name="a"><joint/>{GEOM}</body>', "1 mocap bodies"),
        # A milliradian apart.
        (
            f'<body name="a"><joint name="j"/><joint name="s" type="slide" axis=".001 0 1"/>{GEOM}</body>',
            "joints 'j', 's' of body 'a' together",
        ),
    ],
    ids=["no joints", "mocap", "not quite parallel"],
)
def test_what_is_no_mechanism_here_is_refused(bodies, said):
    with pytest.raises(ValueError, match=said):
        m.read_mjcf(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


def test_urdf_is_read():
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.5"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""
    mechanism = m.read_mjcf(urdf)
    assert [body.name for body in mechanism.bodies] == ["arm"]
    assert np.allclose(mechanism.bodies[0].at, (0, 0, 0.5))
    assert [joint.name for joint in mechanism.joints] == ["j"]


def test_what_is_switched_off_is_left_out():
    held = '</worldbody><equality><joint joint1="hinge" polycoef="0.3 0 0 0 0"/></equality>'
    text = PENDULUM.replace("</worldbody>", held)
    found = m.read_mjcf(text)
    assert (len(found.joints), len(found.loads)) == (2, 3)
    off = 'contact="disable" spring="disable" damper="disable" equality="disable" gravity="disable"'
    found = m.read_mjcf(text.replace('contact="disable"', off))
    assert (len(found.joints), len(found.loads)) == (1, 0)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('springref="10"', 'springref="270"', "less than half a turn"),
        (
            "</worldbody>",
            '</worldbody><equality><joint joint1="hinge" joint2="wheel" polycoef="0 0.3 0 0 0"/></equality>',
            "turns",
        ),
    ],
)
def test_what_would_have_to_count_turns_is_refused(old, new, said):
    wheel = '<body name="wheel" pos="3 0 1"><joint name="wheel" axis="0 0 1"/><geom size=".1" mass="1"/></body>'
    with pytest.raises(ValueError, match=said):
        m.read_mjcf(PENDULUM.replace('<body name="arm"', wheel + '<body name="arm"').replace(old, new))


FREE_BODY = """<mujoco><option gravity="0 0 -9.81" timestep="5e-5"><flag contact="disable"/></option><worldbody><body name="a" pos="0 0 1"/>
<body name="b" pos="1 0 1"><freejoint/><geom size=".1" mass="1" pos=".5 0 0"/></body></worldbody><equality>{}</equality></mujoco>"""


class TestWelds:
    """A weld holds the anchor, a point of the second body, at the relative pose."""

    def test_with_an_anchor_that_fits_it_is_fixed(self):
        mechanism = m.read_mjcf(FREE_BODY.format('<weld body1="a" body2="b" anchor=".1 .2 .3"/>'))
        assert mechanism.rank(mechanism.assemble())[1] == 7

    @pytest.mark.parametrize(
        ("equality", "body"),
        [
            ('<weld name="w" body1="b" body2="part"/>', "b"),
            ('<connect name="w" body1="a" body2="world" anchor="0 0 0"/>', "ground"),
        ],
    )
    def test_between_two_parts_of_one_body_it_is_refused(self, equality, body):
        text = FREE_BODY.format(equality).replace('pos=".5 0 0"/>', 'pos=".5 0 0"/><body name="part"/>')
        with pytest.raises(ValueError, match=f"equality 'w', which is between two parts of '{body}'"):
            m.read_mjcf(text)

    def test_with_an_anchor_elsewhere_it_is_refused(self):
        weld = '<weld name="w" body1="a" body2="b" anchor=".1 .2 .3" relpose="1 0 0 1 0 0 0"/>'
        with pytest.raises(ValueError, match="weld 'w', whose relative pose"):
            m.read_mjcf(FREE_BODY.format(weld))

    def test_without_a_torque_it_is_a_ball_joint(self):
        text = FREE_BODY.format('<weld body1="a" body2="b" torquescale="0"/>')
        mechanism = m.read_mjcf(text)
        solver = dae_jax.OrthogonalProjection(dae_jax.DOP853())
        sol = dae_jax.daesolve(mechanism.system(), solver, 0.0, 0.3, None, mechanism.assemble())
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=6000)
        # MuJoCo's weld is soft.
        np.testing.assert_allclose(sol.ys[0]["b"][-1][:3], data.geom_xpos[0], atol=1e-3)


def test_constraints_that_are_switched_off_are():
    """Two arms that hold each other, were it not for the flag; and nothing is left out that MuJoCo would have."""
    arm = '<body name="{}" pos="{} 0 0"><joint name="{}" axis="0 1 0" range="-9 9"/><geom size=".1" mass="1" pos=".5 0 0"/></body>'
    arms = arm.format("a", 0, "y") + arm.format("b", 1, "z")
    text = (
        '<mujoco><option><flag constraint="disable"/></option><worldbody>{}</worldbody><equality>{}</equality></mujoco>'
    )
    mechanism = m.read_mjcf(text.format(arms, '<joint joint1="y" joint2="z" polycoef="0 -1 0 0 0"/>'))
    assert [joint.name for joint in mechanism.joints] == ["y", "z"]


@pytest.mark.parametrize(
    ("where", "what", "said"),
    [
        ("<joint ", 'springyield="5" ', "springyield of joint 'g'"),
        ("<joint ", 'armature="1" ', "armature of joint 'g'"),
        ("<joint ", 'frictionloss="-1" ', "frictionloss of joint 'g'"),
        ('name="b" ', 'gravcomp="1" ', "gravcomp of body 'b'"),
    ],
)
def test_what_is_not_known_is_not_passed_over(where, what, said):
    text = """<mujoco><worldbody><body name="b" pos="0 0 1"><joint name="g" axis="0 1 0" stiffness="30"/><geom size=".1"
    contype="0" conaffinity="0" pos=".5 0 0"/></body></worldbody></mujoco>"""
    m.read_mjcf(text)
    with pytest.raises(ValueError, match=said):
        m.read_mjcf(text.replace(where, where + what))


def test_fields_of_a_later_version_are_refused_where_they_are_set(monkeypatch):
    from dae_jax.mechanisms import mjcf

    known = {**mjcf.KNOWN, "jnt": mjcf.KNOWN["jnt"].replace("stiffness ", "")}
    monkeypatch.setattr(mjcf, "KNOWN", known)
    with pytest.raises(ValueError, match="stiffness of joint 'hinge'"):
        m.read_mjcf(PENDULUM)


@pytest.mark.parametrize("source", [3, None, b"<mujoco/>"])
def test_what_is_no_file_is_refused(source):
    with pytest.raises(TypeError, match="`source` must be the path of a file or the text of one, but is"):
        m.read_mjcf(source)


def test_a_joint_that_is_held_is_so_whatever_would_follow_another():
    held = '</worldbody><equality><joint name="e" joint1="hinge" polycoef="0.3 1 2 0 0"/></equality>'
    mechanism = m.read_mjcf(PENDULUM.replace("</worldbody>", held))
    np.testing.assert_allclose(mechanism.joints[-1].coefficients, [0.3])


def test_a_pair_in_contact_is_named():
    text = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/><body pos="0 0 .2">
    <freejoint/><geom name="ball" size=".1" contype="0" conaffinity="0"/></body></worldbody>
    <contact><pair geom1="floor" geom2="ball"/></contact></mujoco>"""
    with pytest.warns(UserWarning, match="contacts of 'floor', 'ball'"):
        m.read_mjcf(text)


def test_names_that_mujoco_allows_twice():
    geom = '<geom size=".1" contype="0" conaffinity="0"/>'
    bodies = "".join(
        f'<body {name} pos="{k} 0 0"><joint {joint} axis="0 1 0"/>{geom}</body>'
        for k, (name, joint) in enumerate(
            [('name="body 2"', 'name="x"'), ("", ""), ('name="ground"', 'name="joint 1"')]
        )
    )
    equality = '<equality><joint name="x" joint1="x" joint2="joint 1"/></equality>'
    mechanism = m.read_mjcf(f"<mujoco><worldbody>{bodies}</worldbody>{equality}</mujoco>")
    assert [body.name for body in mechanism.bodies] == ["body 2", "body body 2", "body ground"]
    assert [joint.name for joint in mechanism.joints] == ["x", "joint joint 1", "joint 1", "equality x"]
