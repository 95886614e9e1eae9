"""Ready mechanisms, as scenes: a five-bar linkage with a motor, and a Stewart platform with six loops."""

from typing import cast

import numpy as np
from jaxtyping import Array, Float

from ..scenes.scene import Scene, State, minimal
from ..systems import ConstrainedSystem
from .bodies import Body, ground
from .configuration import Coordinates
from .interface import AbstractJoint
from .joints import prismatic, revolute, spherical, universal
from .loads import AbstractLoad, damper, gravity, motor, spring
from .mechanism import Mechanism


# Of the five-bar: lengths of cranks and couplers, the distance of the pivots, masses of the rods.
CRANK, COUPLER, BASE = 1.0, 1.8, 1.2
MASSES = np.array([1.0, 1.5, 1.5, 1.0])
LENGTHS = np.array([CRANK, COUPLER, COUPLER, CRANK])
TORQUE = 3.0
BARS = ("left", "left coupler", "right coupler", "right")


def five_bar_linkage() -> Mechanism:
    """Two cranks on the ground and two couplers that meet, slender rods in the plane; a motor with a constant torque on the left
    crank, and gravity.
    """
    places = np.real(_five_bar(np.array([2.0, 1.0]))).reshape(4, 3)
    inertias = MASSES * LENGTHS**2 / 12
    bars = [
        Body(name, mass, inertia, at=place[:2], orientation=place[2])
        for name, mass, inertia, place in zip(BARS, MASSES, inertias, places, strict=True)
    ]
    left, first, second, right = bars
    hinge = revolute(ground, left, (0, 0), name="hinge")
    joints = [
        hinge,
        revolute(left, first, anchors=((CRANK / 2, 0), (-COUPLER / 2, 0)), name="left pin"),
        revolute(first, second, anchors=((COUPLER / 2, 0), (COUPLER / 2, 0)), name="top"),
        revolute(right, second, anchors=((CRANK / 2, 0), (-COUPLER / 2, 0)), name="right pin"),
        revolute(ground, right, (BASE, 0), name="right hinge"),
    ]
    return Mechanism(bars, joints, [gravity((0, -9.81)), motor(hinge, torque=TORQUE, name="motor")])


def five_bar() -> Scene[ConstrainedSystem]:
    """`five_bar_linkage` from rest; the reference is of Lagrange's equations in the two cranks' angles, with Jacobians of the
    closed form of the couplers by complex steps.
    """
    mechanism = five_bar_linkage()
    weights = np.stack([MASSES, MASSES, MASSES * LENGTHS**2 / 12], 1).ravel()
    force = np.stack([0 * MASSES, -9.81 * MASSES, 0 * MASSES], 1).ravel()

    def slopes(z: np.ndarray) -> Float[np.ndarray, "12 2"]:
        return np.stack([np.imag(_five_bar(z + 1e-30j * unit)) / 1e-30 for unit in np.eye(2)], 1)

    def field(t: float, z: np.ndarray) -> np.ndarray:
        angles, rates = z[:2], z[2:]
        j, h = slopes(angles), 1e-4
        # By fourth-order differences.
        near = [slopes(angles + k * h * rates) for k in (-2, -1, 1, 2)]
        change = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * h)
        right = j.T @ (force - weights * (change @ rates)) + np.array([TORQUE, 0.0])
        return np.concatenate([rates, np.linalg.solve(j.T @ (weights[:, None] * j), right)])

    def embed(t: float, z: np.ndarray) -> State:
        return np.real(_five_bar(z[:2])), slopes(z[:2]) @ z[2:]

    solved = minimal(field, [2.0, 1.0, 0.0, 0.0], embed)

    def reference(times: np.ndarray) -> tuple[Coordinates, Coordinates]:
        q, v = (x.reshape(-1, 4, 3) for x in solved(times))
        return _bars(q), _bars(v)

    q, v = (np.asarray(x.values) for x in mechanism.reference)
    y0 = (_bars(q), _bars(v))
    return Scene("five-bar", mechanism.system(), y0, 0.6, reference, drawing=mechanism.drawing())


def _bars(values: Float[np.ndarray, "*times 4 3"]) -> Coordinates:
    # A scene's states are arrays of numpy.
    return Coordinates(cast(Array, values), BARS)


def _five_bar(z: np.ndarray) -> np.ndarray:
    """(x, y, φ) of the four rods for the angles of the cranks, the couplers' joint above; analytic in z."""
    arm = lambda angle: np.stack([np.cos(angle), np.sin(angle)])
    left, right = CRANK * arm(z[0]), np.array([BASE, 0.0]) + CRANK * arm(z[1])
    apart = right - left
    square = apart @ apart
    height = np.sqrt(COUPLER**2 / square - 0.25)
    top = (left + right) / 2 + height * np.stack([-apart[1], apart[0]])
    # An analytic arctangent, in the half plane around the vertical.
    towards = lambda d: np.pi / 2 - np.arctan(d[0] / d[1])
    middle = [left / 2, (left + top) / 2, (right + top) / 2, (np.array([BASE, 0.0]) + right) / 2]
    angles = [z[0], towards(top - left), towards(top - right), z[1]]
    return np.concatenate([np.append(p, a) for p, a in zip(middle, angles, strict=True)])


def stewart_platform(stiffness: float = 2000.0, damping: float = 0.0) -> Mechanism:
    """A platform on six legs, each a universal joint on the ground, a slider with a spring and a ball joint: 13 bodies, 91 coordinates,
    6 loops, 85 equations. It starts with a push, from where the springs are relaxed.
    """
    ring = lambda degrees, radius, height: np.stack(
        [radius * np.cos(np.deg2rad(degrees)), radius * np.sin(np.deg2rad(degrees)), 0 * degrees + height], 1
    )
    base = ring(np.array([20.0, 100, 140, 220, 260, 340]), 1.0, 0.0)
    top = ring(np.array([40.0, 80, 160, 200, 280, 320]), 0.6, 1.0)
    platform = Body("platform", 10.0, (0.9, 1.0, 1.7), at=(0, 0, 1), velocity=(0.2, 0.1, 0.0), spin=(0.1, 0.2, 0.5))
    bodies, joints = [platform], []
    loads: list[AbstractLoad | AbstractJoint] = [gravity((0, 0, -9.81))]
    for k, (foot, head) in enumerate(zip(base, top, strict=True)):
        along = (head - foot) / np.linalg.norm(head - foot)
        side = np.cross(along, (0, 0, 1)) / np.linalg.norm(np.cross(along, (0, 0, 1)))
        cylinder = Body(f"cylinder {k}", 1.0, (0.02, 0.02, 0.005), at=foot + 0.25 * (head - foot))
        rod = Body(f"rod {k}", 0.5, (0.01, 0.01, 0.002), at=foot + 0.75 * (head - foot))
        leg = prismatic(cylinder, rod, axis=along, name=f"leg {k}")
        bodies += [cylinder, rod]
        joints += [
            universal(ground, cylinder, foot, axes=(side, np.cross(side, along)), name=f"foot {k}"),
            leg,
            spherical(rod, platform, head, name=f"head {k}"),
        ]
        loads.append(spring(leg, stiffness, name=f"spring {k}"))
        loads += [damper(leg, damping, name=f"damper {k}")] if damping else []
    return Mechanism(bodies, joints, loads)
