"""What of a mechanism is drawn: centres of mass, joints, and the lines between them."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..scenes.scene import Drawing
from ..types import Time
from .bodies import GROUND
from .configuration import Coordinates, Marker
from .contacts import Distance, Rolling
from .loads import Along


if TYPE_CHECKING:
    from .mechanism import Mechanism


# So many points make a rim.
RIM = 24


class Points(eqx.Module):
    """The centres of mass, and after them a list of markers, in the world."""

    mechanism: "Mechanism"
    markers: tuple[Marker, ...]

    def __call__(self, t: Time, q: Coordinates) -> Float[Array, "points d"]:
        at = self.mechanism.configuration(q)
        centres = at.poses.position[:-1]
        return jnp.concatenate([centres, *(marker.position(at)[None] for marker in self.markers)])


def drawing(mechanism: "Mechanism") -> Drawing:
    """Each body as lines from its centre of mass to its joints (through it, where there are two), wheels as their rims with a spoke,
    springs between their ends.
    """
    names = [body.name for body in mechanism.bodies]
    springs = [
        load.coordinate for load in mechanism.loads if isinstance(load, Along) and load.coordinate.kind == "distance"
    ]
    markers = [marker for x in (*mechanism.joints, *springs) for marker in (x.on_a, x.on_b)]
    at = lambda k: len(names) + k
    links = {(names.index(marker.body), at(k)) for k, marker in enumerate(markers) if marker.body != GROUND}
    rods = {(at(2 * k), at(2 * k + 1)) for k, joint in enumerate(mechanism.joints) if isinstance(joint, Distance)}
    first = 2 * len(mechanism.joints)
    pairs = tuple((at(first + 2 * k), at(first + 2 * k + 1)) for k in range(len(springs)))
    for joint in mechanism.joints:
        if isinstance(joint, Rolling):
            rim = [at(len(markers) + k) for k in range(RIM)]
            links |= {(names.index(joint.on_b.body), rim[0]), *zip(rim, [*rim[1:], rim[0]], strict=True)}
            markers += _rim(joint)
    return Drawing(
        Points(mechanism, tuple(markers)),
        {name: k for k, name in enumerate(names)},
        tuple(sorted(links | rods)),
        pairs,
    )


def _rim(wheel: Rolling) -> list[Marker]:
    """Points of a wheel around its axis."""
    angles = 2 * np.pi * np.arange(RIM) / RIM
    spokes = wheel.radius * (wheel.on_b.frame[:, :2] @ np.stack([np.cos(angles), np.sin(angles)]))
    return [wheel.on_b.moved_to(wheel.on_b.point + spoke) for spoke in spokes.T]
