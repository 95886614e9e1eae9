"""A five-bar linkage with a motor."""

import numpy as np

from ...scenes.scene import Scene
from ...systems import ConstrainedSystem
from ..bodies import Body, ground
from ..joints import revolute
from ..loads import gravity, motor
from ..mechanism import Mechanism
from .minimal_coordinates import at_start, reduced


# Lengths of cranks and couplers, the distance of the pivots, masses of the rods.
CRANK, COUPLER, BASE = 1.0, 1.8, 1.2
MASSES = np.array([1.0, 1.5, 1.5, 1.0])
LENGTHS = np.array([CRANK, COUPLER, COUPLER, CRANK])
TORQUE, GRAVITY = 3.0, (0.0, -9.81)
BARS = ("left", "left coupler", "right coupler", "right")
START = (2.0, 1.0)


def five_bar_linkage() -> Mechanism:
    """Two cranks on the ground and two couplers that meet, slender rods in the plane; a motor with a constant torque on the left
    crank, and gravity.
    """
    inertias = MASSES * LENGTHS**2 / 12
    bars = [
        Body(name, mass, inertia, at=place[:2], orientation=place[2])
        for name, mass, inertia, place in zip(BARS, MASSES, inertias, _places(np.array(START)), strict=True)
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
    return Mechanism(bars, joints, [gravity(GRAVITY), motor(hinge, torque=TORQUE, name="motor")])


def five_bar() -> Scene[ConstrainedSystem]:
    """Two cranks, one with a motor, and two couplers, `five_bar_linkage`; against minimal coordinates, the angles of the cranks."""
    mechanism = five_bar_linkage()
    reference = reduced(
        mechanism.bodies, _places, (START, (0.0, 0.0)), GRAVITY, lambda z: z[:1], lambda t, c, rates: np.array([TORQUE])
    )
    return Scene("five-bar", mechanism.system(), at_start(reference), 0.6, reference, drawing=mechanism.drawing())


def _places(z: np.ndarray) -> np.ndarray:
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
    return np.stack([np.append(p, a) for p, a in zip(middle, angles, strict=True)])
