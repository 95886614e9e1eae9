"""MuJoCo: joint coordinates, no contacts or limits, RK4 with a fixed step; `mj_step` runs all its steps in C.

It has no tolerance: the step is 0.25 rtol^(1/4), so that the rows span the same range of errors. It asks for a positive
inertia; 1e-14 beside the point masses is below every error in the tables.
"""

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
