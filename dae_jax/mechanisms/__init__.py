"""Mechanisms as people have them: bodies, joints and loads, in the plane and in space, as a `ConstrainedSystem`."""

from .bodies import Body as Body, Ground as Ground, ground as ground
from .configuration import Coordinate as Coordinate, Coordinates as Coordinates
from .contacts import (
    between as between,
    distance as distance,
    point_on_curve as point_on_curve,
    rolling as rolling,
)
from .couplings import coupling as coupling
from .examples import (
    EXAMPLES as EXAMPLES,
    delta as delta,
    delta_robot as delta_robot,
    disc as disc,
    engine as engine,
    engine_with_four_cylinders as engine_with_four_cylinders,
    five_bar as five_bar,
    five_bar_linkage as five_bar_linkage,
    rolling_disc as rolling_disc,
    stewart as stewart,
    stewart_platform as stewart_platform,
)
from .interface import AbstractJoint as AbstractJoint
from .joints import (
    cylindrical as cylindrical,
    fixed as fixed,
    planar as planar,
    prismatic as prismatic,
    revolute as revolute,
    spherical as spherical,
    universal as universal,
)
from .loads import (
    AbstractLoad as AbstractLoad,
    damper as damper,
    force as force,
    friction as friction,
    gravity as gravity,
    motor as motor,
    spring as spring,
    torque as torque,
)
from .mechanism import Mechanism as Mechanism
from .mjcf import read_mjcf as read_mjcf
from .paths import point_on_path as point_on_path
