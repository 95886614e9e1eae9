"""A Stewart platform: six loops."""

import numpy as np

from ...scenes.scene import Scene
from ...systems import ConstrainedSystem
from ..bodies import Body, ground
from ..interface import AbstractJoint
from ..joints import prismatic, spherical, universal
from ..loads import AbstractLoad, damper, gravity, spring
from ..mechanism import Mechanism
from .minimal_coordinates import at_start, from_matrix, normalised, reduced, rotated


GRAVITY = (0.0, 0.0, -9.81)
STIFFNESS = 2000.0
# Of the platform: where it is, its velocity and its spin at the start.
CENTRE, VELOCITY, SPIN = np.array([0.0, 0.0, 1.0]), (0.2, 0.1, 0.0), (0.1, 0.2, 0.5)


def _ring(degrees: tuple[float, ...], radius: float, height: float) -> np.ndarray:
    angles = np.deg2rad(degrees)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles + height], 1)


FEET, HEADS = _ring((20, 100, 140, 220, 260, 340), 1.0, 0.0), _ring((40, 80, 160, 200, 280, 320), 0.6, 1.0)
SPANS = HEADS - FEET
SIDES = normalised(np.cross(SPANS, (0, 0, 1)))


def stewart_platform(stiffness: float = STIFFNESS, damping: float = 0.0) -> Mechanism:
    """A platform on six legs, each a universal joint on the ground, a slider with a spring and a ball joint: 13 bodies, 91 coordinates,
    6 loops, 85 equations. It starts with a push, from where the springs are relaxed.
    """
    platform = Body("platform", 10.0, (0.9, 1.0, 1.7), at=CENTRE, velocity=VELOCITY, spin=SPIN)
    bodies, joints = [platform], []
    loads: list[AbstractLoad | AbstractJoint] = [gravity(GRAVITY)]
    for k, (foot, head, span, side) in enumerate(zip(FEET, HEADS, SPANS, SIDES, strict=True)):
        cylinder = Body(f"cylinder {k}", 1.0, (0.02, 0.02, 0.005), at=foot + 0.25 * span)
        rod = Body(f"rod {k}", 0.5, (0.01, 0.01, 0.002), at=foot + 0.75 * span)
        leg = prismatic(cylinder, rod, axis=span, name=f"leg {k}")
        bodies += [cylinder, rod]
        joints += [
            universal(ground, cylinder, foot, axes=(side, np.cross(side, span)), name=f"foot {k}"),
            leg,
            spherical(rod, platform, head, name=f"head {k}"),
        ]
        loads.append(spring(leg, stiffness, name=f"spring {k}"))
        loads += [damper(leg, damping, name=f"damper {k}")] if damping else []
    return Mechanism(bodies, joints, loads)


def stewart() -> Scene[ConstrainedSystem]:
    """A Stewart platform, `stewart_platform`: six legs with springs; against minimal coordinates, place and turn of the platform."""
    mechanism = stewart_platform()
    lengths = np.sqrt(np.sum(SPANS**2, 1))

    def along(z: np.ndarray) -> np.ndarray:
        return np.sqrt(np.sum(_spans(z) ** 2, 1))

    start = ((*CENTRE, 0.0, 0.0, 0.0), (*VELOCITY, *(np.array(SPIN) / 2)))
    effort = lambda t, c, rates: -STIFFNESS * (c - lengths)
    reference = reduced(mechanism.bodies, _places, start, GRAVITY, along, effort)
    return Scene("stewart", mechanism.system(), at_start(reference), 1.0, reference, drawing=mechanism.drawing())


def _turn(z: np.ndarray) -> np.ndarray:
    """The quaternion whose vector part is the last three of z."""
    return np.concatenate([[np.sqrt(1 - z[3:] @ z[3:])], z[3:]])


def _spans(z: np.ndarray) -> np.ndarray:
    return z[:3] + rotated(_turn(z), HEADS - CENTRE) - FEET


def _places(z: np.ndarray) -> np.ndarray:
    """(position, quaternion) of the platform, and of cylinder and rod of each leg; analytic in z."""
    # A leg does not turn about itself: the axis of its universal joint that it carries stays perpendicular to the ground's.
    spans = _spans(z)
    turned = np.einsum("lij,lkj->lik", _frames(spans), _frames(SPANS))
    e, quarters = from_matrix(turned), 0.25 * np.einsum("lij,lj->li", turned, SPANS)
    legs = np.stack([np.concatenate([FEET + quarters, e], 1), np.concatenate([FEET + spans - quarters, e], 1)], 1)
    return np.concatenate([z[:3], _turn(z), legs.ravel()]).reshape(-1, 7)


def _frames(spans: np.ndarray) -> np.ndarray:
    """Axes of the legs as columns: along, the one that is carried, and a third."""
    along, across = normalised(spans), normalised(np.cross(SIDES, spans))
    return np.stack([along, across, np.cross(along, across)], 2)
