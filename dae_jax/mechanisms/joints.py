"""Joints: the lower pairs, each by as many equations as it takes degrees of freedom.

With the markers p_a, F_a = (x_a, y_a, z_a) on a and p_b, F_b on b, z (in the plane x) along the joint's axis, and d = p_b − p_a:

| joint | equations in space | in the plane |
|---|---|---|
| `revolute` | d = 0, x_a·z_b = y_a·z_b = 0 | d = 0 |
| `prismatic` | d·x_a = d·y_a = 0, x_a·z_b = y_a·z_b = x_a·y_b = 0 | d·y_a = 0, φ_b − φ_a = const |
| `cylindrical` | d·x_a = d·y_a = 0, x_a·z_b = y_a·z_b = 0 | |
| `spherical` | d = 0 | |
| `universal` | d = 0, x_a·y_b = 0 | |
| `planar` | d·z_a = 0, x_a·z_b = y_a·z_b = 0 | |
| `fixed` | d = 0, x_a·z_b = y_a·z_b = x_a·y_b = 0 | d = 0, φ_b − φ_a = const |

Source: E. J. Haug, *Computer-Aided Kinematics and Dynamics of Mechanical Systems*, sections 3.3 and 9.4.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ..types import Args, Time
from .bodies import Numbers
from .configuration import Configuration, Coordinate, Kind, Marker, at_rows
from .interface import AbstractHolonomicJoint
from .placement import (
    Part,
    Points,
    centre,
    dimension_of,
    frame_along,
    label_of,
    markers,
    refuse_axis,
    refuse_plane,
    two,
    unit,
)


class Joint(AbstractHolonomicJoint):
    """A lower pair: the displacement along some axes of a's frame is 0, and some axes of the two are perpendicular.

    - `locked`: the axes of a's frame along which p_b does not move.
    - `perpendicular`: pairs of an axis of a and one of b, or in the plane whether the angle is fixed.
    - `free`: the kinds of coordinates that are left.
    """

    name: str = eqx.field(static=True)
    on_a: Marker
    on_b: Marker
    locked: tuple[int, ...] = eqx.field(static=True)
    perpendicular: tuple[tuple[int, int], ...] = eqx.field(static=True)
    free: tuple[Kind, ...] = eqx.field(static=True)

    @property
    def turns(self) -> tuple[tuple[int, int], ...]:
        """The pairs of axes that are perpendicular, in space."""
        return self.perpendicular if len(self.on_a.point) == 3 else ()

    @property
    def slides(self) -> tuple[int, ...]:
        """The axes of a's frame along which d is 0; none where all of d are, in any axes, and simplest in the world's."""
        return self.locked if len(self.locked) < len(self.on_a.point) else ()

    def constraint(self, t: Time, at: Configuration, args: Args) -> Float[Array, " k"]:
        return pairs([self], at)

    def is_reversed(self, at: Configuration) -> Bool[Array, ""]:
        """Whether axes point against each other that go together: the equations, that they are perpendicular to others, allow both."""
        pairs = set(self.turns)
        axes = [2] * ({(0, 2), (1, 2)} <= pairs) + [0] * ({(0, 2), (1, 2), (0, 1)} <= pairs)
        facing = [jnp.sum(self.on_a.axis(at, i) * self.on_b.axis(at, i)) for i in axes]
        return jnp.any(jnp.stack([jnp.ones(()), *facing]) < 0)

    @property
    def coordinates(self) -> dict[Kind, Coordinate]:
        return {kind: Coordinate(self.name, kind, self.on_a, self.on_b) for kind in self.free}


def pairs(joints: Sequence[Joint], at: Configuration) -> Float[Array, " m"]:
    """The equations of lower pairs, one after the other: all at once, so that a program does not grow with their number."""
    if not joints:
        return jnp.zeros(0, at.rows.dtype)
    d, n = at.dimension, len(joints)
    markers = [marker for joint in joints for marker in (joint.on_a, joint.on_b)]
    bodies = np.array([at.row(marker.body) for marker in markers])
    points, frames, angles = (jnp.stack(x) for x in zip(*(marker.arrays for marker in markers), strict=True))
    axes, left, right = _products(joints)
    columns = jnp.swapaxes(frames, 1, 2).reshape(-1, d)
    arms = [points, at_rows(columns, np.array([m * d + i for m, i in axes]))] if axes else [points]
    carriers = np.concatenate([bodies, bodies[[m for m, _ in axes]]])
    turned = jnp.sum(at_rows(at.poses.rotation, carriers) * jnp.concatenate(arms)[:, None, :], 2)
    ends = at_rows(at.poses.position, bodies) + turned[: 2 * n]
    apart = ends[1::2] - ends[::2]
    every = [jnp.ravel(apart)]
    if axes:
        vectors = jnp.concatenate([turned[2 * n :], apart])
        every.append(jnp.sum(at_rows(vectors, left) * at_rows(vectors, right), 1))
    if d == 2:
        # Axes do not show whole turns.
        turns = at_rows(at.rows[:, 2], bodies) - angles
        every.append(turns[1::2] - turns[::2])
    return at_rows(jnp.concatenate(every), _order(joints))


def _products(joints: Sequence[Joint]) -> tuple[list[tuple[int, int]], Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """The axes that the equations ask for, each by its marker and its column; and of which two vectors their products are, in a list
    of these axes and d of each joint.
    """
    asked = [
        ((2 * k, i), other)
        for k, joint in enumerate(joints)
        for i, other in (*((i, None) for i in joint.slides), *((i, (2 * k + 1, j)) for i, j in joint.turns))
    ]
    axes = sorted({axis for pair in asked for axis in pair if axis is not None})
    place = {axis: k for k, axis in enumerate(axes)}
    left = np.array([place[a] for a, _ in asked], int)
    right = np.array([len(axes) + a[0] // 2 if b is None else place[b] for a, b in asked], int)
    return axes, left, right


def _order(joints: Sequence[Joint]) -> Int[np.ndarray, " m"]:
    """Where the equations stand in d of all joints, and then products and angles, of which joint by joint those are taken that it has."""
    d = len(joints[0].on_a.point)
    counts = [len(joint.slides) + len(joint.turns) for joint in joints]
    first, found = d * len(joints), []
    for k, (joint, count) in enumerate(zip(joints, counts, strict=True)):
        found += [] if joint.slides or not joint.locked else [d * k + i for i in range(d)]
        found += range(first, first + count)
        found += [d * len(joints) + sum(counts) + k] if d == 2 and joint.perpendicular else []
        first += count
    return np.array(found)


def revolute(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    axis: Numbers | None = None,
    anchors: Points | None = None,
    name: str | None = None,
) -> Joint:
    """A hinge: b turns against a about a point, in space about an axis through it.

    **Arguments**

    - `a`, `b`: two bodies, or a body and `ground`.
    - `at`: the point in the world, in m, in the reference configuration.
    - `axis`: its direction in the world there, of any length; in space only.
    - `anchors`: in place of `at`, the point of a and the point of b that the joint brings together, each in its body's axes (from
      the centre of mass). They need not meet in the reference configuration: `Mechanism.assemble` brings them together.
    - `name`: "a-b" if not given.

    Errors: `ValueError` for a joint of a body with itself, an axis of length 0, points of the wrong shape.
    """
    if dimension_of(a, b) == 2:
        refuse_axis(label_of(a, b, name), axis)
        return _pair("revolute", a, b, at, anchors, name, (0, 1), (), ("angle",), axis)
    return _pair("revolute", a, b, at, anchors, name, (0, 1, 2), ((0, 2), (1, 2)), ("angle",), axis)


def prismatic(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    axis: Numbers,
    anchors: Points | None = None,
    name: str | None = None,
) -> Joint:
    """A slider: b moves along an axis that is fixed in a, and does not turn against it. Arguments as those of `revolute`; without
    `at`, the point is b's centre of mass.
    """
    at = centre(b, at, anchors)
    if dimension_of(a, b) == 2:
        return _pair("prismatic", a, b, at, anchors, name, (1,), ((0, 1),), ("displacement",), axis)
    rows = ((0, 2), (1, 2), (0, 1))
    return _pair("prismatic", a, b, at, anchors, name, (0, 1), rows, ("displacement",), axis)


def cylindrical(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    axis: Numbers,
    anchors: Points | None = None,
    name: str | None = None,
) -> Joint:
    """b moves along an axis of a and turns about it; in space. Arguments as those of `prismatic`. It has two coordinates, `joint.angle`
    and `joint.displacement`.
    """
    refuse_plane("cylindrical", a, b)
    at = centre(b, at, anchors)
    return _pair("cylindrical", a, b, at, anchors, name, (0, 1), ((0, 2), (1, 2)), ("angle", "displacement"), axis)


def spherical(
    a: Part, b: Part, at: Numbers | None = None, *, anchors: Points | None = None, name: str | None = None
) -> Joint:
    """A ball joint: b turns freely against a about a point; in space. Arguments as those of `revolute`."""
    refuse_plane("spherical", a, b)
    return _pair("spherical", a, b, at, anchors, name, (0, 1, 2), (), (), (0, 0, 1))


def universal(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    axes: Points,
    anchors: Points | None = None,
    name: str | None = None,
) -> Joint:
    """A Cardan joint: `axes` are that fixed in a and that fixed in b, perpendicular in the reference configuration and ever after; in
    space. Other arguments as those of `revolute`.
    """
    refuse_plane("universal", a, b)
    label = label_of(a, b, name)
    x, y = (unit(label, axis, 3) for axis in two(label, "axes", axes))
    slant = jnp.sum(x * y)
    if not isinstance(slant, Tracer) and abs(slant) > 1e-6:
        raise ValueError(f"Joint {label!r}: the two axes of a universal joint must be perpendicular.")
    z = jnp.cross(x, y)
    return _pair("universal", a, b, at, anchors, name, (0, 1, 2), ((0, 1),), (), None, jnp.stack([x, y, z], 1))


def planar(
    a: Part,
    b: Part,
    at: Numbers | None = None,
    *,
    normal: Numbers,
    anchors: Points | None = None,
    name: str | None = None,
) -> Joint:
    """b slides on a plane of a and turns about its normal, its angle; in space. Arguments as those of `prismatic`."""
    refuse_plane("planar", a, b)
    at = centre(b, at, anchors)
    return _pair("planar", a, b, at, anchors, name, (2,), ((0, 2), (1, 2)), ("angle",), normal)


def fixed(
    a: Part, b: Part, at: Numbers | None = None, *, anchors: Points | None = None, name: str | None = None
) -> Joint:
    """b does not move against a. Arguments as those of `prismatic`."""
    at = centre(b, at, anchors)
    if dimension_of(a, b) == 2:
        return _pair("fixed", a, b, at, anchors, name, (0, 1), ((0, 1),), (), None)
    return _pair("fixed", a, b, at, anchors, name, (0, 1, 2), ((0, 2), (1, 2), (0, 1)), (), (0, 0, 1))


def _pair(
    joint: str,
    a: Part,
    b: Part,
    at: Numbers | None,
    anchors: Points | None,
    name: str | None,
    locked: tuple[int, ...],
    perpendicular: tuple[tuple[int, int], ...],
    free: tuple[Kind, ...],
    axis: Numbers | None,
    axes: Float[Array, "3 3"] | None = None,
) -> Joint:
    label, d = label_of(a, b, name), dimension_of(a, b)
    if axes is None:
        if axis is None and d == 3:
            raise ValueError(f"Joint {label!r}: a {joint} joint in space needs an axis.")
        axes = jnp.eye(2) if axis is None else frame_along(unit(label, axis, d))
    return Joint(label, *markers(a, b, label, at, anchors, axes), locked, perpendicular, free)
