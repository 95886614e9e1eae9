"""What a joint is to a mechanism, and the coordinate along which loads, motions and gears act."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..types import Args, Time
from ..validate.states import brief
from .configuration import Configuration, Coordinate, Kind, Marker


class AbstractJoint(eqx.Module):
    """Equations between two bodies, by name: `a` and `b`, whose markers are where reactions are taken."""

    name: eqx.AbstractVar[str]
    on_a: eqx.AbstractVar[Marker]
    on_b: eqx.AbstractVar[Marker]

    @abc.abstractmethod
    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        """What is 0 of the positions."""

    @abc.abstractmethod
    def nonholonomic(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        """What is 0 of the velocities, beyond the derivative of `constraint`."""

    def counts(self, at: Configuration) -> tuple[int, int]:
        """How many equations there are of positions, and how many of velocities; of joints that read no `args`."""
        return len(self.constraint(0.0, at, None)), len(self.nonholonomic(0.0, at, None))

    @property
    @abc.abstractmethod
    def coordinates(self) -> dict[Kind, Coordinate]:
        """What the joint leaves free and has a number for."""

    @property
    def angle(self) -> Coordinate:
        """That of b against a, about the joint's axis."""
        return self._coordinate("angle")

    @property
    def displacement(self) -> Coordinate:
        """That of b against a, along the joint's axis."""
        return self._coordinate("displacement")

    def _coordinate(self, kind: Kind) -> Coordinate:
        if kind not in self.coordinates:
            raise ValueError(f"Joint {self.name!r} has no {kind}.")
        return self.coordinates[kind]


class AbstractHolonomicJoint(AbstractJoint):
    """One all of whose equations are of positions."""

    def nonholonomic(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        return jnp.zeros(0)


def only_coordinate(on: AbstractJoint | Coordinate) -> Coordinate:
    """That of a joint which has one, or itself."""
    if isinstance(on, Coordinate):
        return on
    if not isinstance(on, AbstractJoint):
        raise TypeError(
            f"What acts along a joint takes the joint, `joint.angle` or `between(...)`, but {brief(on)} is none."
        )
    found = on.coordinates
    if len(found) != 1:
        has = " and ".join(f"`joint.{kind}`" for kind in found)
        raise ValueError(
            f"Joint {on.name!r} has "
            + (f"{has}: say which." if found else "no coordinate that a load could act along.")
        )
    return next(iter(found.values()))
