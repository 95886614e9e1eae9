"""A point that is led along a path, and with motors of a given motion all that leads a mechanism."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..types import Args, Time
from .bodies import Numbers
from .configuration import Configuration, Coordinate, Kind, Marker
from .contacts import Motion
from .interface import AbstractHolonomicJoint
from .placement import Part, label_of, markers_of_point, refuse_no_function


class OnPath(AbstractHolonomicJoint):
    """A point of b that is led: p − path(t) = 0, p in the axes of a."""

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    path: Callable[[Time, Args], Array]

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        place, wanted = at.pose(self.on_a.body).local(self.on_b.position(at)), jnp.asarray(self.path(t, args))
        if wanted.shape != place.shape:
            raise ValueError(
                f"Joint {self.name!r}: `path(t, args)` must have the shape {place.shape}, but has {wanted.shape}."
            )
        return place - wanted

    def counts(self, at: Configuration) -> tuple[int, int]:
        return at.dimension, 0

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {}


# What does work on a mechanism as a constraint.
LEADING = (Motion, OnPath)


def point_on_path(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    path: Callable[[Time, Args], Array],
    anchor: Numbers | None = None,
    name: str | None = None,
) -> OnPath:
    """A point of b that is led along a path, by whatever force it takes: `Mechanism.reaction` says which, and
    `Mechanism.inverse_dynamics` which motors could do it instead.

    **Arguments**

    - `path(t, args)`: where the point is at time t, in the axes of a (of the ground: in the world), (2,) or (3,). Two derivatives
      of it are taken.
    - `at`: the point in the world, in the reference configuration, or `anchor`: in the axes of b; its centre of mass if
      neither is given.

    Errors: `ValueError` for a path of another shape.
    """
    label = label_of(a, b, name)
    refuse_no_function(label, "path(t, args)", path)
    return OnPath(label, *markers_of_point(a, b, label, at, anchor), path)
