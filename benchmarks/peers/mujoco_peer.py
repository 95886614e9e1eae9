"""MuJoCo: joint coordinates, no contacts or limits, RK4 with a fixed step; `mj_step` runs all its steps in C.

It has no tolerance: the step is 0.25 rtol^(1/4), so that the rows span the same range of errors. It asks for a positive
inertia; 1e-14 beside the point masses is below every error in the tables. Closed loops: `connect`, as stiff as MuJoCo lets them be at
each step, so that its error falls with the square of the step, 0.1 rtol^(1/2).
"""

import importlib

import numpy as np

from . import missing, problems


name = "MuJoCo"
methods = ("RK4",)


def available():
    return missing("mujoco")


def double_pendulum(rtol, t1=10.0, method="RK4"):
    return chain(2, rtol, t1, method)


def pendulum(rtol, t1=10.0, method="RK4"):
    return chain(1, rtol, t1, method)


def chain(n, rtol, t1=1.0, method="RK4"):
    import mujoco

    steps = round(t1 / (0.25 * rtol**0.25)) + 1
    model = mujoco.MjModel.from_xml_string(_model(n, t1 / steps, method))
    data = mujoco.MjData(model)
    angles, rates = problems.joint_start(n)

    def solve():
        mujoco.mj_resetData(model, data)
        data.qpos[:] = angles
        data.qvel[:] = rates
        mujoco.mj_step(model, data, nstep=steps)

    solve()
    return problems.from_joints(data.qpos, data.qvel), solve


def _model(n, step, integrator):
    link = (
        '<body pos="0 0 {}"><joint type="hinge" axis="0 -1 0"/>'
        '<inertial pos="0 0 -1" mass="1" diaginertia="1e-14 1e-14 1e-14"/>'
    )
    bodies = "".join(link.format(-1 if i else 0) for i in range(n)) + "</body>" * n
    return (
        f'<mujoco><compiler boundinertia="0"/>'
        f'<option integrator="{integrator}" timestep="{step!r}" gravity="0 0 {-problems.GRAVITY}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{bodies}</worldbody></mujoco>"
    )


loop_methods = ("RK4",)


def loops(problem, rtol, method):
    import mujoco

    from benchmarks.loops import example

    scene = example(problem)
    steps = round(scene.t1 / (0.1 * rtol**0.5)) + 1
    step = scene.t1 / steps
    model = mujoco.MjModel.from_xml_string(_LOOPS[problem](step, method))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rates = _rates(model, data)

    def solve():
        mujoco.mj_resetData(model, data)
        data.qvel[:] = rates
        if problem == "five-bar":
            data.qfrc_applied[0] = _five_bar_numbers().TORQUE
        mujoco.mj_step(model, data, nstep=steps)

    solve()
    mujoco.mj_kinematics(model, data)
    return np.stack([data.body(name).xipos for name in scene.y0[0].names]), solve


def _rates(model, data):
    """Rates of all joints that go with those of the platform: rows of the equalities times them are 0."""
    import mujoco

    rates = np.zeros(model.nv)
    if model.nv < 6:
        return rates
    numbers = _stewart_numbers()
    rates[:6] = [*numbers.VELOCITY, *numbers.SPIN]
    rows = np.zeros((data.nefc, model.nv))
    mujoco.mju_sparse2dense(rows, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    rates[6:] = np.linalg.lstsq(rows[:, 6:], -rows[:, :6] @ rates[:6], rcond=None)[0]
    return rates


def _five_bar_numbers():
    return importlib.import_module("dae_jax.mechanisms.examples.five_bar")


def _stewart_numbers():
    return importlib.import_module("dae_jax.mechanisms.examples.stewart")


def _five_bar(step, integrator):
    m = _five_bar_numbers()

    def rod(body, length, place, turn, child=""):
        return (
            f'<body name="{body.name}" pos="{_words(place)}" euler="0 0 {turn!r}"><joint type="hinge" axis="0 0 1"/>'
            f"{_inertial(body, (length / 2, 0, 0))}{child}</body>"
        )

    left, first, second, right = m.five_bar_linkage().bodies
    turn = lambda body, carrier=None: float(body.orientation) - (float(carrier.orientation) if carrier else 0.0)
    tip = (m.CRANK, 0, 0)
    bodies = rod(left, m.CRANK, (0, 0, 0), turn(left), rod(first, m.COUPLER, tip, turn(first, left)))
    bodies += rod(right, m.CRANK, (m.BASE, 0, 0), turn(right), rod(second, m.COUPLER, tip, turn(second, right)))
    closed = f'<connect body1="left coupler" body2="right coupler" anchor="{m.COUPLER} 0 0"/>'
    return _with_loops(step, integrator, "0 -9.81 0", bodies, closed)


def _stewart(step, integrator):
    m = _stewart_numbers()
    of = {body.name: body for body in m.stewart_platform().bodies}
    bodies = f'<body name="platform" pos="{_words(m.CENTRE)}"><freejoint/>{_inertial(of["platform"], (0, 0, 0))}</body>'
    closed = ""
    for k, (foot, head, span, side) in enumerate(zip(m.FEET, m.HEADS, m.SPANS, m.SIDES, strict=True)):
        bodies += (
            f'<body name="cylinder {k}" pos="{_words(foot)}"><joint axis="{_words(side)}"/>'
            f'<joint axis="{_words(np.cross(side, span))}"/>'
            f"{_inertial(of[f'cylinder {k}'], 0.25 * span)}"
            f'<body name="rod {k}"><joint type="slide" axis="{_words(span)}" stiffness="{m.STIFFNESS}"/>'
            f"{_inertial(of[f'rod {k}'], 0.75 * span)}</body></body>"
        )
        closed += f'<connect body1="platform" body2="rod {k}" anchor="{_words(head - m.CENTRE)}"/>'
    return _with_loops(step, integrator, "0 0 -9.81", bodies, closed)


_LOOPS = {"five-bar": _five_bar, "stewart": _stewart}


def _with_loops(step, integrator, gravity, bodies, closed):
    return (
        '<mujoco><compiler angle="radian"/>'
        f'<option integrator="{integrator}" timestep="{step!r}" gravity="{gravity}" tolerance="0" iterations="20" jacobian="sparse">'
        f'<flag contact="disable"/></option><default><equality solref="{2 * step!r} 1" solimp="0.9999 0.9999 0.001 0.5 2"/></default>'
        f"<worldbody>{bodies}</worldbody><equality>{closed}</equality></mujoco>"
    )


def _inertial(body, centre):
    """Mass and principal moments; of a body in the plane, three that are alike."""
    moments = np.diag(np.asarray(body.inertia) * np.eye(3))
    return f'<inertial pos="{_words(centre)}" mass="{float(body.mass)!r}" diaginertia="{_words(moments)}"/>'


def _words(numbers):
    return " ".join(repr(float(x)) for x in numbers)
