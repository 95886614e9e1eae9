"""A delta robot: three arms, and a platform that does not turn."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ...scenes.scene import Scene
from ...systems import ConstrainedSystem
from ..bodies import Body, ground
from ..contacts import distance
from ..interface import AbstractJoint
from ..joints import revolute
from ..loads import AbstractLoad, gravity, motor
from ..mechanism import Mechanism
from .minimal_coordinates import after, at_start, reduced, rotated, turn


# Radii of base and platform, half the distance of the two rods of an arm, lengths of arms and rods, in m.
BASE, PLATFORM, HALF, ARM, ROD = 0.2, 0.06, 0.05, 0.25, 0.55
AZIMUTHS = np.deg2rad([0.0, 120.0, 240.0])
GRAVITY, START = (0.0, 0.0, -9.81), (0.05, -0.03, -0.5)
# Of the motors: N m/rad, N m s/rad, rad, rad, 1/s.
STIFFNESS, DAMPING, MIDDLE, SWING, FREQUENCY = 40.0, 1.5, 0.3, 0.25, 8.0


def delta_robot() -> Mechanism:
    """Three arms on a base above, each with a motor and two parallel rods without mass to the platform, which they keep from turning:
    4 bodies in space, 6 rods, 21 equations beside the quaternions'. The motors are springs with dampers towards angles that swing.
    """
    rows = _places(np.array(START))
    platform = Body("platform", 0.8, (2e-3, 2e-3, 3e-3), at=rows[0, :3])
    bodies, joints = [platform], []
    loads: list[AbstractLoad | AbstractJoint] = [gravity(GRAVITY)]
    for k, (azimuth, row, angle) in enumerate(zip(AZIMUTHS, rows[1:], _angles(np.array(START)), strict=True)):
        out, aside = _directions(azimuth)
        # A slender rod along its x axis.
        arm = Body(f"arm {k}", 0.3, (1e-4, 0.3 * ARM**2 / 12, 0.3 * ARM**2 / 12), at=row[:3], orientation=row[3:])
        hinge = revolute(ground, arm, BASE * out, axis=aside, name=f"hinge {k}")
        bodies.append(arm)
        joints += [
            hinge,
            *(
                distance(
                    arm,
                    platform,
                    anchors=((ARM / 2, side, 0), PLATFORM * out + side * aside),
                    length=ROD,
                    name=f"rod {k}{label}",
                )
                for side, label in ((HALF, "a"), (-HALF, "b"))
            ),
        ]
        # The angle of the joint counts from the reference configuration.
        controller = lambda t, c, rate, args, at=azimuth, zero=angle: _torque(
            jnp.sin(FREQUENCY * t + at), c + zero, rate
        )
        loads.append(motor(hinge, torque=controller, name=f"motor {k}"))
    return Mechanism(bodies, joints, loads)


def delta() -> Scene[ConstrainedSystem]:
    """A delta robot, `delta_robot`: three arms with motors, and a platform that does not turn; against minimal coordinates, its place."""
    mechanism = delta_robot()
    effort = lambda t, c, rates: _torque(np.sin(FREQUENCY * t + AZIMUTHS), c, rates)
    reference = reduced(mechanism.bodies, _places, (START, (0.0, 0.0, 0.0)), GRAVITY, _angles, effort)
    return Scene("delta", mechanism.system(), at_start(reference), 1.0, reference, drawing=mechanism.drawing())


def _torque(swing: Any, angle: Any, rate: Any) -> Any:
    """That of a motor, in N m."""
    return STIFFNESS * (MIDDLE + SWING * swing - angle) - DAMPING * rate


def _directions(azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Outwards, and aside."""
    return np.array([np.cos(azimuth), np.sin(azimuth), 0]), np.array([-np.sin(azimuth), np.cos(azimuth), 0])


def _angles(z: np.ndarray) -> np.ndarray:
    """Of the arms, downwards from the horizontal, elbows outwards: x cos a − z sin a = (|p|² + arm² − rod²)/(2 arm) for the place
    p = (x, y, z) of the platform's joint from the arm's hinge, x outwards; analytic in z.
    """
    found = []
    for azimuth in AZIMUTHS:
        out, _ = _directions(azimuth)
        p = z + (PLATFORM - BASE) * out
        x, down = p @ out, -p[2]
        middle = np.pi / 2 - np.arctan(x / down)
        found.append(middle - np.arccos((p @ p + ARM**2 - ROD**2) / (2 * ARM) / np.sqrt(x**2 + down**2)))
    return np.stack(found)


def _places(z: np.ndarray) -> np.ndarray:
    """(position, quaternion) of the platform and of the arms; analytic in z."""
    rows = [np.concatenate([z, [1, 0, 0, 0]])]
    for azimuth, angle in zip(AZIMUTHS, _angles(z), strict=True):
        e = after(turn((0, 0, 1), azimuth), turn((0, 1, 0), angle))
        rows.append(np.concatenate([BASE * _directions(azimuth)[0] + rotated(e, np.array([ARM / 2, 0, 0])), e]))
    return np.stack(rows)
