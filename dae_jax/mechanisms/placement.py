"""Where a joint is on its two bodies: markers from points and axes in the world, or from points of the bodies."""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..validate.states import brief
from .bodies import Body, Ground, Numbers, numbers
from .configuration import Marker, marker
from .rotations import frame


Part = Body | Ground
Points = tuple[Numbers, Numbers]


def markers(
    a: Part, b: Part, label: str, at: Numbers | None, anchors: Points | None, axes: Float[Array, "d d"] | None = None
) -> tuple[Marker, Marker]:
    """Those of a joint on a and b, from a point in the world or from a point of each."""
    d = dimension_of(a, b)
    refuse_both_or_none(label, at, anchors)
    axes = jnp.eye(d) if axes is None else axes
    if anchors is None:
        assert at is not None
        point = _vector(label, "at", at, d)
        return marker(a, point, axes), marker(b, point, axes)
    local = [_vector(label, "anchors", p, d) for p in two(label, "anchors", anchors)]
    on = [marker(body, jnp.zeros(d), axes) for body in (a, b)]
    return on[0].moved_to(local[0]), on[1].moved_to(local[1])


def refuse_both_or_none(label: str, at: object, anchors: object) -> None:
    """Refuses a place that is given twice, or not at all."""
    if (at is None) == (anchors is None):
        raise ValueError(
            f"Joint {label!r}: give either `at`, a point in the world, or `anchors`, a point of each body."
        )


def markers_of_point(a: Part, b: Part, label: str, at: Numbers | None, anchor: Numbers | None) -> tuple[Marker, Marker]:
    """The axes of a, and a point of b, its centre of mass if none is given."""
    if at is not None and anchor is not None:
        raise ValueError(f"Joint {label!r}: give either `at`, a point in the world, or `anchor`, one of {b.name!r}.")
    if at is not None:
        return markers(a, b, label, at, None)
    zero = jnp.zeros(dimension_of(a, b))
    return markers(a, b, label, None, (zero, zero if anchor is None else anchor))


def centre(b: Part, at: Numbers | None, anchors: Points | None) -> Numbers | None:
    """Where a joint is: at b's centre of mass, where no point is given."""
    return b.at if at is None and anchors is None and isinstance(b, Body) else at


def two(label: str, what: str, given: Points) -> Points:
    """Two points or axes, one of each body."""
    try:
        first, second = given
    except (TypeError, ValueError):
        raise ValueError(f"Joint {label!r}: `{what}` must be two, one of each body, but is {brief(given)}.") from None
    return first, second


def dimension_of(a: Part, b: Part) -> Literal[2, 3]:
    """2 for bodies in the plane, 3 in space."""
    for body in (a, b):
        if not isinstance(body, Body | Ground):
            raise TypeError(f"A joint is between two bodies, or a body and `ground`, but {brief(body)} is none.")
    found = {body.dimension for body in (a, b) if isinstance(body, Body)}
    if len(found) != 1:
        what = "one is planar and one is spatial" if found else "neither moves"
        raise ValueError(
            f"A joint needs two bodies of one kind, or a body and the ground; of {a.name!r} and {b.name!r} {what}."
        )
    return 2 if found == {2} else 3


def refuse_plane(joint: str, a: Part, b: Part) -> None:
    """Refuses bodies in the plane."""
    if dimension_of(a, b) == 2:
        raise ValueError(f"A {joint} joint is one of bodies in space, but {a.name!r} and {b.name!r} are planar.")


def refuse_axis(label: str, axis: Numbers | None) -> None:
    """Refuses an axis of what turns in the plane."""
    if axis is not None:
        raise ValueError(f"Joint {label!r}: bodies in the plane turn about its normal, and `axis` is none of theirs.")


def refuse_no_function(label: str, call: str, given: object) -> None:
    """Refuses what cannot be called."""
    if not callable(given):
        raise TypeError(f"{label!r} must have a function `{call}`, but has {brief(given)}.")


def label_of(a: Part, b: Part, name: str | None) -> str:
    """The name of what is between two bodies, which must not be the same."""
    dimension_of(a, b)
    label = f"{a.name}-{b.name}" if name is None else name
    if a.name == b.name:
        raise ValueError(f"Joint {label!r} is between {a.name!r} and itself, and needs two bodies.")
    return label


def _vector(label: str, what: str, value: Numbers, d: int) -> Float[Array, " d"]:
    return numbers(f"Joint {label!r}: `{what}`", value, (d,))


def unit(label: str, axis: Numbers, d: int) -> Float[Array, " d"]:
    """The direction of an axis, which must have one."""
    length, direction = _polar(_vector(label, "axis", axis, d))
    if not isinstance(length, Tracer) and not (np.isfinite(length) and length > 0):
        raise ValueError(f"Joint {label!r} has an axis of length {float(length):g}, which has no direction.")
    return direction


@functools.partial(jax.jit, inline=True)
def _polar(vector: Float[Array, " d"]) -> tuple[Float[Array, ""], Float[Array, " d"]]:
    length = jnp.sqrt(jnp.sum(vector**2))
    return length, vector / length


def frame_along(axis: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Columns with the axis first in the plane, last in space."""
    return jnp.stack([axis, jnp.stack([-axis[1], axis[0]])], 1) if len(axis) == 2 else frame(axis)
