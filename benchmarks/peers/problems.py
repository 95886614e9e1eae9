"""The problems that every peer solves, their starts and their references. Unit masses and lengths, g = 9.81, y down.

States are flat: positions (x1, y1, x2, y2, ...), then velocities in the same order.
"""

import numpy as np


GRAVITY = 9.81

# Double pendulum released horizontally at rest, t = 10: heyoka's Taylor method at 140 bits and tolerance 1e-30. An
# independent extended-precision Taylor series agrees to its 9 digits, Radau IIA and DOP853 here to 10.
DOUBLE_PENDULUM_10 = np.array(
    [
        -0.53834723961222639,
        0.84272311562095892,
        -1.0407657832461705,
        1.7073476624693274,
        5.1223954488726695,
        3.2722817245506318,
        -3.2483466434254820,
        -1.5918134095484712,
    ]
)


def chain_start(n):
    """n links stretched out horizontally, at rest; n = 1 is the pendulum, n = 2 the double pendulum."""
    state = np.zeros(4 * n)
    state[0 : 2 * n : 2] = np.arange(1, n + 1)
    return state


def double_pendulum_starts(angles):
    """The double pendulum at rest for each row (θ1, θ2) of `angles`, measured from the downward vertical."""
    joint = np.concatenate([np.asarray(angles), np.zeros((len(angles), 2))], axis=1)
    return np.array([from_angles(row[:2], row[2:]) for row in joint]).reshape(-1, 8)


def joint_start(n):
    """`chain_start` in joint coordinates: the angle of each link to the one before, and the angular velocities."""
    angles = np.zeros(n)
    angles[0] = np.pi / 2
    return angles, np.zeros(n)


def from_joints(joints, rates):
    """The Cartesian state from joint angles (each relative to the link before) and their rates."""
    return from_angles(np.cumsum(joints), np.cumsum(rates))


def from_angles(angles, rates):
    """The Cartesian state from angles to the downward vertical and their rates."""
    sin, cos = np.sin(angles), np.cos(angles)
    links, link_rates = np.stack([sin, cos], -1), np.stack([rates * cos, -rates * sin], -1)
    return np.concatenate([np.cumsum(links, 0).ravel(), np.cumsum(link_rates, 0).ravel()])


def pendulum_exact(t):
    """The pendulum released horizontally at rest: sin(θ/2) = k sn(ωt + K | k²), θ̇ = 2ωk cn(ωt + K | k²), k² = 1/2."""
    from scipy.special import ellipj, ellipk

    k, omega = np.sqrt(0.5), np.sqrt(GRAVITY)
    sn, cn, _, _ = ellipj(omega * t + ellipk(0.5), 0.5)
    return from_angles(np.array([2 * np.arcsin(k * sn)]), np.array([2 * omega * k * cn]))
