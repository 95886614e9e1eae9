"""Joints that are no lower pairs: a rod without mass, a point on a curve, a wheel that rolls, and a motor whose motion is given."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..types import Args, Time
from ..validate.user_functions import refuse_no_numbers, returned
from .bodies import Numbers, numbers, reference_pose
from .configuration import Configuration, Coordinate, Kind, Marker
from .interface import AbstractHolonomicJoint, AbstractJoint
from .placement import (
    Part,
    Points,
    dimension_of,
    frame_along,
    label_of,
    markers,
    markers_of_point,
    refuse_axis,
    refuse_both_or_none,
    refuse_no_function,
    two,
    unit,
)


class Distance(AbstractHolonomicJoint):
    """A rod without mass between two points, (|d|² − ℓ²)/(2ℓ) = 0."""

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    length: Float[Array, ""]

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        difference = self.on_b.position(at) - self.on_a.position(at)
        return (jnp.sum(difference**2)[None] - self.length**2) / (2 * self.length)

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {}


class OnCurve(AbstractHolonomicJoint):
    """A point of b on a curve, or in space on a surface, of a: 0 = curve(p), p in the axes of a."""

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    curve: Callable[[Array], Array]

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        return jnp.ravel(jnp.asarray(self.curve(at.pose(self.on_a.body).local(self.on_b.position(at)))))

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {}


class Rolling(AbstractJoint):
    """A wheel, or a ball, on a plane of a. With the plane's normal n and the wheel's axis u, the point of contact is at

        ρ = −R (n − (n·u) u)/|n − (n·u) u|        (−R n of a ball, and in the plane)

    from the centre p_b, the wheel touches, n·(p_b − p_a + ρ) = 0, and does not slip: the velocities of the two bodies there are
    equal along the plane.
    """

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    radius: Float[Array, ""]
    disc: bool = eqx.field(static=True)

    def _contact(self, at: Configuration) -> Float[Array, " d"]:
        n = self._normal(at)
        if self.disc:
            u = self.on_b.axis(at, 2)
            n = n - jnp.sum(n * u) * u
            n = n / jnp.sqrt(jnp.sum(n**2))
        return -self.radius * n

    def _normal(self, at: Configuration) -> Float[Array, " d"]:
        return self.on_a.axis(at, 0 if at.dimension == 2 else 2)

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        touching = self.on_b.position(at) - self.on_a.position(at) + self._contact(at)
        return jnp.sum(touching * self._normal(at))[None]

    def nonholonomic(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        contact = self.on_b.position(at) + self._contact(at)
        of_a, of_b = (at.twist(m.body).at(contact - at.pose(m.body).position) for m in (self.on_a, self.on_b))
        along = (1,) if at.dimension == 2 else (0, 1)
        return jnp.stack([jnp.sum((of_b - of_a) * self.on_a.axis(at, i)) for i in along])

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {}


class Motion(AbstractHolonomicJoint):
    """A motor whose motion is given: c(q) − motion(t) = 0 of an angle, a displacement or a distance c; of an angle in space
    within (−π, π], which is smooth there for any number of turns.
    """

    name: str = eqx.field(static=True)
    coordinate: Coordinate
    motion: Callable[[Time, Args], Array]

    @property
    def on_a(self) -> Marker:
        return self.coordinate.on_a

    @property
    def on_b(self) -> Marker:
        return self.coordinate.on_b

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        wanted = jnp.asarray(self.motion(t, args))
        if wanted.size != 1:
            raise ValueError(
                f"Motor {self.name!r}: `motion(t, args)` must be a number, but has the shape {wanted.shape}."
            )
        return self.coordinate.off(at, jnp.reshape(wanted, ()))[None]

    def counts(self, at: Configuration) -> tuple[int, int]:
        return 1, 0

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {self.coordinate.kind: self.coordinate}


def distance(
    a: Part,
    b: Part,
    at: Points | None = None,
    *,
    length: Numbers | None = None,
    anchors: Points | None = None,
    name: str | None = None,
) -> Distance:
    """A rod without mass between a point of a and a point of b.

    **Arguments**

    - `at`: the two points in the world, in the reference configuration; or `anchors`: in the axes of their bodies.
    - `length`: in m; that in the reference configuration if not given.

    Errors: `ValueError` for a length that is not positive.
    """
    label, on = label_of(a, b, name), between(a, b, at, anchors=anchors, name=name)
    if length is None:
        length = jnp.sqrt(jnp.sum((_in_reference(b, on.on_b) - _in_reference(a, on.on_a)) ** 2))
    return Distance(label, on.on_a, on.on_b, _positive(label, "length", length))


def between(
    a: Part, b: Part, at: Points | None = None, *, anchors: Points | None = None, name: str | None = None
) -> Coordinate:
    """The distance of a point of a from a point of b, for a spring, a damper or a motor between them. Arguments as those of
    `distance`.
    """
    label = label_of(a, b, name)
    refuse_both_or_none(label, at, anchors)
    if at is None:
        return Coordinate(label, "distance", *markers(a, b, label, None, anchors))
    (on_a, _), (_, on_b) = (markers(a, b, label, point, None) for point in two(label, "at", at))
    return Coordinate(label, "distance", on_a, on_b)


def point_on_curve(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    curve: Callable[[Array], Array],
    anchor: Numbers | None = None,
    name: str | None = None,
) -> OnCurve:
    """A point of b on a curve of a, which is given by equations: in the plane one, `curve(p)` = 0; in space a curve by two, a
    surface by one.

    **Arguments**

    - `curve(p)`: the equations, p the point in the axes of a (of the ground: in the world).
    - `at`: the point in the world, in the reference configuration, or `anchor`: in the axes of b; its centre of mass if
      neither is given.
    """
    label, d = label_of(a, b, name), dimension_of(a, b)
    on_a, on_b = markers_of_point(a, b, label, at, anchor)
    refuse_no_function(label, "curve(p)", curve)
    p = jax.ShapeDtypeStruct((d,), on_b.point.dtype)
    refuse_no_numbers(returned("curve(p)", curve, p), "curve(p)")
    shape = jax.eval_shape(lambda p: jnp.asarray(curve(p)), p).shape
    if sum(shape) >= d or len(shape) > 1:
        raise ValueError(f"Joint {label!r}: `curve(p)` must be 1 to {d - 1} equations, but has the shape {shape}.")
    return OnCurve(label, on_a, on_b, curve)


def rolling(
    a: Part,
    wheel: Part,
    *,
    radius: Numbers,
    at: Numbers,
    normal: Numbers,
    axis: Numbers | None = None,
    name: str | None = None,
) -> Rolling:
    """A wheel that rolls without slip on a plane (in the plane: on a line) of a.

    **Arguments**

    - `radius`: in m. The wheel's centre is its centre of mass.
    - `at`, `normal`: a point of the plane and its normal towards the wheel, in the world, in the reference configuration.
    - `axis`: the wheel's, in the world there; without it, in space, it is a ball.
    """
    label, d = label_of(a, wheel, name), dimension_of(a, wheel)
    on_a, _ = markers(a, wheel, label, at, None, frame_along(unit(label, normal, d)))
    if d == 2:
        refuse_axis(label, axis)
    axes = jnp.eye(d) if axis is None else frame_along(unit(label, axis, d))
    _, on_b = markers(a, wheel, label, None, (jnp.zeros(d), jnp.zeros(d)), axes)
    return Rolling(label, on_a, on_b, _positive(label, "radius", radius), d == 3 and axis is not None)


def _in_reference(body: Part, at: Marker) -> Float[Array, " d"]:
    return reference_pose(body, len(at.point)).point(at.point)


def _positive(label: str, what: str, value: Numbers) -> Float[Array, ""]:
    number = numbers(f"Joint {label!r}: `{what}`", value)
    if not isinstance(number, Tracer) and not (number.ndim == 0 and np.asarray(number) > 0):
        raise ValueError(f"Joint {label!r}: `{what}` must be a positive number, but is {value}.")
    return number
