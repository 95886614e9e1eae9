"""Pinocchio's articulated-body algorithm (O(n), joint coordinates) under scipy's DOP853."""

import numpy as np

from . import missing, problems


name = "Pinocchio + scipy"
methods = ("DOP853",)


def available():
    return missing("pinocchio", "scipy")


def double_pendulum(rtol, t1=10.0, method="DOP853"):
    return chain(2, rtol, t1, method)


def pendulum(rtol, t1=10.0, method="DOP853"):
    return chain(1, rtol, t1, method)


def chain(n, rtol, t1=1.0, method="DOP853"):
    import pinocchio
    from scipy.integrate import solve_ivp

    model = pinocchio.Model()
    model.gravity.linear = np.array([0.0, 0.0, -problems.GRAVITY])
    mass = pinocchio.Inertia(1.0, np.array([0.0, 0.0, -1.0]), np.zeros((3, 3)))
    joint = 0
    for i in range(n):
        hinge = pinocchio.SE3(np.eye(3), np.array([0.0, 0.0, -1.0 if i else 0.0]))
        joint = model.addJoint(joint, pinocchio.JointModelRX(), hinge, f"joint{i}")
        model.appendBodyToJoint(joint, mass, pinocchio.SE3.Identity())
    data, torque, aba = model.createData(), np.zeros(n), pinocchio.aba
    start = np.concatenate(problems.joint_start(n))

    def field(t, y):
        return np.concatenate([y[n:], aba(model, data, y[:n], y[n:], torque)])

    def solve():
        return solve_ivp(field, (0.0, t1), start, method=method, rtol=rtol, atol=rtol).y[:, -1]

    end = solve()
    return problems.from_joints(end[:n], end[n:]), solve
