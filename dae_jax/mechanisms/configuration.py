"""All bodies at one instant: poses and twists by name; markers, which are points with axes on a body; coordinates of joints."""

import functools
from typing import Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .bodies import Body, Ground, Pose, Twist, dimension, ground, ground_row, pose, reference_row, twist
from .rotations import conjugate, product, rotate


Kind = Literal["angle", "displacement", "distance"]


class Coordinates(eqx.Module):
    """The coordinates of all bodies, or their velocities, or the forces on them: `q["crank"]` is that of one body. The state of a
    mechanism is a pair (q, v) of these. A solution's have a leading axis of times.
    """

    values: Float[Array, "*times bodies k"]
    names: tuple[str, ...] = eqx.field(static=True)

    def __getitem__(self, name: str) -> Float[Array, "*times k"]:
        return self.values[..., self._row(name), :]

    def put(self, name: str, row: Float[Array, " k"]) -> "Coordinates":
        """The same with another row for one body."""
        return Coordinates(self.values.at[self._row(name)].set(row), self.names)

    def _row(self, name: str) -> int:
        if name not in self.names:
            raise KeyError(f"There is no body {name!r}; bodies are {', '.join(self.names)}.")
        return self.names.index(name)


class Configuration:
    """All bodies at one instant, the ground as the last row: coordinates, poses, and with velocities the twists."""

    def __init__(self, bodies: tuple[Body, ...], q: Coordinates, v: Coordinates | None = None) -> None:
        self.bodies, self.q, self.v, self.names = bodies, q, v, (*q.names, ground.name)
        self.dimension = 2 if q.values.shape[1] == 3 else 3
        below = jnp.asarray(ground_row(self.dimension), q.values.dtype)[None]
        self.rows = jnp.concatenate([q.values, below])
        self.velocities = None if v is None else jnp.concatenate([v.values, 0 * below])

    @functools.cached_property
    def poses(self) -> Pose:
        """Where all are."""
        return jax.vmap(pose)(self.rows)

    @property
    def masses(self) -> Float[Array, " bodies"]:
        """Those of the bodies."""
        return jnp.stack([body.mass for body in self.bodies])

    @property
    def inertias(self) -> Float[Array, "bodies ..."]:
        """Those of the bodies, in their axes."""
        return jnp.stack([body.inertia for body in self.bodies])

    def row(self, name: str) -> int:
        """Which row a body has."""
        return self.names.index(name)

    def pose(self, name: str) -> Pose:
        """Where a body is."""
        k = self.row(name)
        return jax.tree.map(lambda x: x[k], self.poses)

    def twist(self, name: str) -> Twist:
        """How it moves."""
        assert self.velocities is not None
        k = self.row(name)
        return twist(self.rows[k], self.velocities[k])

    def table(self, name: str, row: Float[Array, " k"]) -> Float[Array, "bodies k"]:
        """Forces on all bodies of which one is not 0."""
        return jnp.asarray(np.arange(len(self.q.names)) == self.row(name), row.dtype)[:, None] * row


def at_rows(x: Float[Array, "n *k"], rows: Int[np.ndarray, " m"]) -> Float[Array, "m *k"]:
    """x[rows], in one equation where that is several: programs of mechanisms are full of it."""
    first, count = int(rows[0]), len(rows)
    if np.array_equal(rows, first + np.arange(count)):
        return lax.slice_in_dim(x, first, first + count)
    numbers = lax.GatherDimensionNumbers(tuple(range(1, x.ndim)), (0,), (0,))
    places = rows[:, None].astype(np.int32)
    return lax.gather(x, places, numbers, (1, *x.shape[1:]), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


MarkerArrays: TypeAlias = tuple[Float[Array, " d"], Float[Array, "d d"], Float[Array, "..."]]


class Marker(eqx.Module):
    """A point of a body, and a frame there whose columns are its axes, in body axes; and how the body is turned in the reference
    configuration, by its angle in the plane, whose turns a frame does not know, and by its quaternion in space, which knows one.
    """

    body: str = eqx.field(static=True)
    point: Float[Array, " d"]
    frame: Float[Array, "d d"]
    reference: Float[Array, "..."]

    def moved_to(self, point: Float[Array, " d"]) -> "Marker":
        """The same axes at another point of the body."""
        return Marker(self.body, point, self.frame, self.reference)

    def position(self, at: Configuration) -> Float[Array, " d"]:
        """The point in the world."""
        return at.pose(self.body).point(self.point)

    @property
    def arrays(self) -> MarkerArrays:
        """Point, frame and reference."""
        return self.point, self.frame, self.reference

    def axis(self, at: Configuration, column: int) -> Float[Array, " d"]:
        """An axis of the frame, in world axes."""
        return rotate(at.pose(self.body).rotation, self.frame[:, column])


class Coordinate(eqx.Module):
    """What a joint leaves free, or the distance of two points: a number c(q) along which springs, dampers and motors act.

    - `angle`: of b against a, in rad, 0 in the reference configuration; in space about the joint's axis and within (−π, π].
    - `displacement`: of b against a along the axis, in m.
    - `distance`: of the two points, in m.
    """

    name: str = eqx.field(static=True)
    kind: Kind = eqx.field(static=True)
    on_a: Marker
    on_b: Marker

    def __call__(self, at: Configuration) -> Float[Array, ""]:
        """c(q)."""
        a, b = at.row(self.on_a.body), at.row(self.on_b.body)
        return value(self.kind, at.rows[a], at.rows[b], self.on_a.arrays, self.on_b.arrays)

    def with_rate(self, at: Configuration) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """c and ċ."""
        assert at.velocities is not None
        a, b = at.row(self.on_a.body), at.row(self.on_b.body)
        c = lambda qa, qb: value(self.kind, qa, qb, self.on_a.arrays, self.on_b.arrays)
        return jax.jvp(c, (at.rows[a], at.rows[b]), (at.velocities[a], at.velocities[b]))

    @property
    def is_turn(self) -> bool:
        """Whether it is an angle in space, whose whole turns are not known."""
        return self.kind == "angle" and self.on_a.point.shape[0] == 3

    def off(self, at: Configuration, wanted: Float[Array, ""]) -> Float[Array, ""]:
        """c − wanted; of an angle in space within (−π, π], smooth where it is near 0, whatever turns there have been."""
        if not self.is_turn:
            return self(at) - wanted
        x = self.on_b.axis(at, 0)
        sine, cosine = jnp.sum(x * self.on_a.axis(at, 1)), jnp.sum(x * self.on_a.axis(at, 0))
        s, c = jnp.sin(wanted), jnp.cos(wanted)
        return jnp.arctan2(sine * c - cosine * s, cosine * c + sine * s)


def value(
    kind: Kind, q_a: Float[Array, " k"], q_b: Float[Array, " k"], on_a: MarkerArrays, on_b: MarkerArrays
) -> Float[Array, ""]:
    """A coordinate, from those of two bodies."""
    a, b, d = pose(q_a), pose(q_b), dimension(q_a)
    if kind == "angle":
        if d == 2:
            return (q_b[2] - on_b[2]) - (q_a[2] - on_a[2])
        x = rotate(b.rotation, on_b[1][:, 0])
        return jnp.arctan2(
            jnp.sum(x * rotate(a.rotation, on_a[1][:, 1])), jnp.sum(x * rotate(a.rotation, on_a[1][:, 0]))
        )
    difference = b.point(on_b[0]) - a.point(on_a[0])
    if kind == "displacement":
        return jnp.sum(difference * rotate(a.rotation, on_a[1][:, axis_of(d)]))
    # Of two points that coincide too c ∂c/∂q has its derivatives, of a spring whose rest is 0 there the stiffness: the added length
    # is below round-off, and that to the power 1 − 2 n, as in n derivatives of the root, below what is too large for a number.
    kind_of_number = jnp.finfo(difference.dtype)
    n = 3 if kind_of_number.bits > 32 else 2
    return jnp.sqrt(jnp.sum(difference**2) + float(kind_of_number.tiny) ** (2 / (2 * n - 1)))


def is_within_half_a_turn(
    q_a: Float[Array, " k"], q_b: Float[Array, " k"], reference_a: Float[Array, "4"], reference_b: Float[Array, "4"]
) -> Bool[Array, ""]:
    """Whether b has turned in space by less than half a turn against a since the reference configuration, where their quaternions
    were these. Beyond it is false for another full turn: quaternions on the way do not jump.
    """
    # A flag has no derivatives.
    e_a, e_b = lax.stop_gradient((q_a[3:], q_b[3:]))
    return jnp.sum(product(e_a, conjugate(reference_a)) * product(e_b, conjugate(reference_b))) > 0


def axis_of(dimension: int) -> int:
    """The column of a joint's frame that is its axis: x in the plane, z in space."""
    return 0 if dimension == 2 else 2


def marker(body: Body | Ground, point: Float[Array, " d"], frame: Float[Array, "d d"]) -> Marker:
    """The marker that is at a point of the world, with these axes, in the reference configuration."""
    row = reference_row(body, point.shape[0])
    reference = row[2] if point.shape[0] == 2 else row[3:]
    place, axes = _in_body_axes(pose(row), point, frame)
    return Marker(body.name, place, axes, reference)


@functools.partial(jax.jit, inline=True)
def _in_body_axes(place: Pose, point: Float[Array, " d"], frame: Float[Array, "d d"]) -> tuple[Array, Array]:
    return place.local(point), jnp.sum(place.rotation[:, :, None] * frame[:, None, :], 0)
