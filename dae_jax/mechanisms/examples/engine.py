"""A V engine with four cylinders."""

from typing import Any

import numpy as np

from ...scenes.scene import Scene
from ...systems import ConstrainedSystem
from ..bodies import Body, ground
from ..interface import AbstractJoint
from ..joints import prismatic, revolute
from ..loads import AbstractLoad, friction, gravity, motor
from ..mechanism import Mechanism
from .minimal_coordinates import at_start, reduced


# Lengths of crank and rods, where the centre of mass of a rod is from its crank pin, in m; masses in kg, moments in kg m².
CRANK, ROD, CENTRE = 0.04, 0.13, 0.04
SHAFT, RODS, PISTONS = (12.0, 0.1), (0.5, 1e-3), (0.4, 3e-4)
# Of each cylinder: the direction of its bank and of its throw from the shaft's, in rad.
BANKS, THROWS = np.deg2rad([135.0, 45.0, 135.0, 45.0]), np.deg2rad([0.0, 0.0, 180.0, 180.0])
# The gas: pressure outside in Pa, area in m², height of the chamber at the upper dead centre in m, exponent.
PRESSURE, AREA, CLEARANCE, GAMMA = 1e5, 5e-3, 0.01, 1.4
FRICTION, GRAVITY, SPEED = 0.05, (0.0, -9.81), 150.0


def engine_with_four_cylinders() -> Mechanism:
    """Two banks of two cylinders at right angles, in the plane: a crankshaft with two throws, four rods, four pistons, and the gas
    that they compress and that drives them back, without burning: p = p₀ (h₀/h)^γ, h the height of the chamber. Nine bodies, four
    loops, 26 equations.
    """
    rows = _places(np.zeros(1))
    body = lambda name, data, row: Body(name, *data, at=row[:2], orientation=row[2])
    shaft = body("shaft", SHAFT, rows[0])
    hinge = revolute(ground, shaft, (0, 0), name="shaft hinge")
    bodies, joints = [shaft], [hinge]
    loads: list[AbstractLoad | AbstractJoint] = [gravity(GRAVITY), friction(hinge, viscous=FRICTION, name="bearing")]
    for k, (bank, throw) in enumerate(zip(BANKS, THROWS, strict=True)):
        rod, piston = (body(f"{what} {k + 1}", data, row) for what, data, row in (
            ("rod", RODS, rows[1 + 2 * k]), ("piston", PISTONS, rows[2 + 2 * k])
        ))  # fmt: skip
        pin = CRANK * np.array([np.cos(throw), np.sin(throw)])
        # The ground's point is the shaft, so that the displacement is the distance from it.
        slide = prismatic(
            ground, piston, anchors=((0, 0), (0, 0)), axis=(np.cos(bank), np.sin(bank)), name=f"cylinder {k + 1}"
        )
        bodies += [rod, piston]
        joints += [
            revolute(shaft, rod, anchors=(pin, (-CENTRE, 0)), name=f"crank pin {k + 1}"),
            revolute(rod, piston, anchors=((ROD - CENTRE, 0), (0, 0)), name=f"piston pin {k + 1}"),
            slide,
        ]
        loads.append(motor(slide, torque=lambda t, c, rate, args: _gas(c), name=f"gas {k + 1}"))
    return Mechanism(bodies, joints, loads)


def engine() -> Scene[ConstrainedSystem]:
    """A V engine, `engine_with_four_cylinders`, that runs down from 150 rad/s; against minimal coordinates, the angle of its shaft."""
    mechanism = engine_with_four_cylinders()

    def effort(t: float, c: np.ndarray, rates: np.ndarray) -> np.ndarray:
        return np.concatenate([-FRICTION * rates[:1], _gas(c[1:])])

    along = lambda z: np.concatenate([z, _distances(z[0])])
    reference = reduced(mechanism.bodies, _places, ((0.0,), (SPEED,)), GRAVITY, along, effort)
    return Scene("engine", mechanism.system(), at_start(reference), 0.1, reference, drawing=mechanism.drawing())


def _gas(distance: Any) -> Any:
    """The force of the gas on a piston, outwards, in N."""
    height = CRANK + ROD + CLEARANCE - distance
    return -PRESSURE * AREA * (((2 * CRANK + CLEARANCE) / height) ** GAMMA - 1)


def _distances(angle: np.ndarray) -> np.ndarray:
    """Of the pistons from the shaft, in m."""
    between = angle + THROWS - BANKS
    return CRANK * np.cos(between) + np.sqrt(ROD**2 - (CRANK * np.sin(between)) ** 2)


def _places(z: np.ndarray) -> np.ndarray:
    """(x, y, φ) of the shaft, and of the rod and the piston of each cylinder; analytic in z."""
    rows = [np.append(np.zeros(2), z)]
    for bank, throw, distance in zip(BANKS, THROWS, _distances(z[0]), strict=True):
        across = CRANK * np.sin(z[0] + throw - bank)
        turned = bank - np.arcsin(across / ROD)
        pin = CRANK * np.array([np.cos(z[0] + throw), np.sin(z[0] + throw)])
        middle = pin + CENTRE * np.array([np.cos(turned), np.sin(turned)])
        rows += [np.append(middle, turned), np.append(distance * np.array([np.cos(bank), np.sin(bank)]), 0.0)]
    return np.stack(rows)
