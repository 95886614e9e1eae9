"""Loads: gravity, springs, dampers, friction and motors along a coordinate, forces and torques on a body.

A spring, damper or motor acts along a coordinate c(q), an angle or a displacement of a joint or the distance of two points, with
an effort τ (a torque in N m or a force in N) that is positive where it makes c grow: the generalised force is τ ∂c/∂q.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..types import Args, Scalar, Time
from ..validate.states import brief
from .bodies import Body, Numbers, generalised, numbers, pose
from .configuration import Configuration, Coordinate, MarkerArrays, at_rows, is_within_half_a_turn, value
from .contacts import Motion
from .interface import AbstractJoint, only_coordinate
from .laws import HALF_TURN, Drive, Friction, Law, Spring
from .placement import refuse_no_function
from .rotations import rotate


Pair: TypeAlias = tuple[Float[Array, " k"], Float[Array, " k"]]


class AbstractLoad(eqx.Module):
    """A force that does work."""

    name: eqx.AbstractVar[str]

    @abc.abstractmethod
    def generalised_force(self, t: Time, at: Configuration, args: Args) -> Float[Array, "bodies k"]:
        """Q, of all bodies."""

    @abc.abstractmethod
    def energy(self, at: Configuration) -> Scalar | None:
        """The potential energy, in J; `None` where there is none."""


class Gravity(AbstractLoad):
    """The weight of all bodies, Q = m g."""

    name: str = eqx.field(static=True)
    acceleration: Float[Array, " d"]

    def generalised_force(self, t: Time, at: Configuration, args: Args) -> Float[Array, "bodies k"]:
        d, values = at.dimension, at.q.values
        weight = at.masses[:, None] * self.acceleration
        return jnp.concatenate([weight, jnp.zeros((len(values), values.shape[1] - d), values.dtype)], 1)

    def energy(self, at: Configuration) -> Scalar | None:
        return -jnp.sum(at.masses[:, None] * self.acceleration * at.q.values[:, : at.dimension])


class Along(AbstractLoad):
    """An effort along a coordinate, Q = τ ∂c/∂q."""

    name: str = eqx.field(static=True)
    coordinate: Coordinate
    law: Law

    @property
    def counts_turns(self) -> bool:
        """Whether half a turn in space must not be passed."""
        return isinstance(self.law, Spring) and self.law.is_turn

    def effort(self, t: Time, at: Configuration, args: Args) -> Scalar:
        """τ."""
        return self.law.effort(t, *self.coordinate.with_rate(at), args)

    def generalised_force(self, t: Time, at: Configuration, args: Args) -> Float[Array, "bodies k"]:
        return along([self], t, at, args)

    def energy(self, at: Configuration) -> Scalar | None:
        return self.law.energy(self.coordinate(at))


def along(loads: Sequence[Along], t: Time, at: Configuration, args: Args) -> Float[Array, "bodies k"]:
    """Q of efforts along coordinates of one kind: all at once, so that a program does not grow with their number."""
    assert at.velocities is not None
    kind = loads[0].coordinate.kind
    ends = [[load.coordinate.on_a for load in loads], [load.coordinate.on_b for load in loads]]
    a, b = (np.array([at.row(marker.body) for marker in on]) for on in ends)
    on_a, on_b = (jax.tree.map(lambda *x: jnp.stack(x), *(marker.arrays for marker in on)) for on in ends)

    def one(q: Pair, v: Pair, on: tuple[MarkerArrays, MarkerArrays]) -> tuple[Scalar, Scalar, Pair]:
        c = lambda q: value(kind, q[0], q[1], on[0], on[1])
        slope = jax.grad(c)(q)
        return c(q), jnp.sum(slope[0] * v[0]) + jnp.sum(slope[1] * v[1]), slope

    q, v = ((at_rows(x, a), at_rows(x, b)) for x in (at.rows, at.velocities))
    c, rate, slopes = jax.vmap(one)(q, v, (on_a, on_b))
    counts = np.array([load.counts_turns for load in loads])
    if counts.any():
        c = jnp.where(jax.vmap(is_within_half_a_turn)(*q, on_a[2], on_b[2]) | ~counts, c, jnp.nan)
    efforts = jnp.stack([load.law.effort(t, c[k], rate[k], args) for k, load in enumerate(loads)])
    total = jnp.zeros_like(at.q.values)
    for rows, slope in zip((a, b), slopes, strict=True):
        acts = jnp.asarray(np.arange(len(total))[:, None] == rows, total.dtype)
        total = total + jnp.sum(acts[:, :, None] * (efforts[:, None] * slope), 1)
    return total


class Applied(AbstractLoad):
    """A force at a point of a body, or a moment."""

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    kind: Literal["force", "torque"] = eqx.field(static=True)
    axes: Literal["world", "body"] = eqx.field(static=True)
    value: Callable[..., Array] | Float[Array, "..."]
    point: Float[Array, " d"]

    def generalised_force(self, t: Time, at: Configuration, args: Args) -> Float[Array, "bodies k"]:
        d, rotation = at.dimension, at.pose(self.body).rotation
        given = jnp.asarray(self.value(t, at.q, at.v, args) if callable(self.value) else self.value)
        shape = (d,) if self.kind == "force" or d == 3 else ()
        if given.shape != shape:
            raise ValueError(f"Load {self.name!r}: the {self.kind} must have the shape {shape}, but has {given.shape}.")
        if self.axes == "body" and given.ndim:
            given = rotate(rotation, given)
        force, torque = (given, jnp.zeros(() if d == 2 else 3)) if self.kind == "force" else (jnp.zeros(d), given)
        row = generalised(at.rows[at.row(self.body)], force, torque, rotate(rotation, self.point))
        return at.table(self.body, row)

    def energy(self, at: Configuration) -> Scalar | None:
        return None


def gravity(acceleration: Numbers, name: str = "gravity") -> Gravity:
    """The weight of all bodies by an acceleration in m/s², such as (0, −9.81): (2,) or (3,)."""
    return Gravity(name, numbers(f"Load {name!r}: `acceleration`", acceleration, (2,), (3,)))


def spring(
    on: AbstractJoint | Coordinate, stiffness: Numbers, rest: Numbers = 0.0, *, name: str | None = None
) -> Along:
    """A linear spring, τ = −k (c − c₀).

    **Arguments**

    - `on`: a joint, whose angle or displacement c is, or `between(a, b, ...)`, the distance of two points.
    - `stiffness`: k, in N/m or N m/rad.
    - `rest`: c₀, in m or rad.

    An angle in space is within (−π, π] of the reference configuration, and its turns are not known: a solve in which one with a
    spring comes near half a turn fails, also where a step leaps over it; quaternions of a state that is put together by hand have
    the sign that they get on the way from there. In the plane turns count.

    Errors: `ValueError` where the rest of an angle in space is half a turn off or more.
    """
    label, coordinate = _along("spring", on, name)
    law = Spring(_number(label, "stiffness", stiffness), _number(label, "rest", rest), coordinate.is_turn)
    if law.is_turn and not isinstance(law.rest, Tracer) and np.abs(law.rest) >= HALF_TURN:
        raise ValueError(
            f"Spring {label!r}: the rest of an angle in space must be less than half a turn from the reference configuration, whose "
            f"turns are not known, but is {float(law.rest):.6g} rad. Take another reference configuration."
        )
    return Along(label, coordinate, law)


def damper(on: AbstractJoint | Coordinate, damping: Numbers, *, name: str | None = None) -> Along:
    """A linear damper, τ = −d ċ, with d in N s/m or N m s. `on` is as that of `spring`."""
    label, coordinate = _along("damper", on, name)
    return Along(label, coordinate, Friction(_number(label, "damping", damping), None, jnp.ones(())))


def friction(
    on: AbstractJoint | Coordinate,
    coulomb: Numbers = 0.0,
    viscous: Numbers = 0.0,
    smoothing: Numbers = 1e-2,
    *,
    name: str | None = None,
) -> Along:
    """Viscous and dry friction, τ = −d ċ − τ_C tanh(ċ/ε).

    **Arguments**

    - `on`: as that of `spring`.
    - `coulomb`: τ_C, the torque in N m or force in N of dry friction, whatever the joint carries.
    - `viscous`: d.
    - `smoothing`: ε, in rad/s or m/s: below this speed dry friction creeps, where in truth it sticks. The smaller, the stiffer.
    """
    label, coordinate = _along("friction", on, name)
    given = (("viscous", viscous), ("coulomb", coulomb), ("smoothing", smoothing))
    law = Friction(*(_number(label, what, value) for what, value in given))
    if not isinstance(law.smoothing, Tracer) and not np.asarray(law.smoothing) > 0:
        raise ValueError(f"Load {label!r}: `smoothing` must be a positive speed, but is {smoothing}.")
    return Along(label, coordinate, law)


def motor(
    on: AbstractJoint | Coordinate,
    *,
    torque: Numbers | Callable[..., Array] | None = None,
    motion: Callable[[Time, Args], Array] | None = None,
    name: str | None = None,
) -> Along | Motion:
    """A motor, with a torque or with a motion that is given.

    **Arguments**

    - `on`: as that of `spring`.
    - `torque`: in N m (N of a displacement), or `torque(t, c, rate, args)`, a controller; an angle c in space is within (−π, π].
    - `motion(t, args)`: the value of c at time t, a constraint; `Mechanism.effort` is what the motor needs for it.

    Errors: `ValueError` unless one of the two is given.
    """
    label, coordinate = _along("motor", on, name)
    if (torque is None) == (motion is None):
        raise ValueError(f"Motor {label!r} needs either a `torque` or a `motion`.")
    if motion is not None:
        refuse_no_function(label, "motion(t, args)", motion)
        # Its markers, fields of other joints, are those of its coordinate.
        return Motion(label, coordinate, motion)  # pyright: ignore[reportCallIssue]
    assert torque is not None
    return Along(label, coordinate, Drive(torque if callable(torque) else _number(label, "torque", torque)))


def force(
    body: Body,
    value: Numbers | Callable[..., Array],
    *,
    at: Numbers | None = None,
    axes: Literal["world", "body"] = "world",
    name: str | None = None,
) -> Applied:
    """A force on a body.

    **Arguments**

    - `value`: (2,) or (3,) in N, or `value(t, q, v, args)` of the states by name.
    - `at`: where it acts on the body, a point in the world in the reference configuration; its centre of mass if not given.
    - `axes`: whether the numbers are along the axes of the world or of the body.
    """
    label, point = _on_body("force", body, name), jnp.zeros(body.dimension)
    if at is not None:
        point = pose(body.reference[0]).local(numbers(f"Load {label!r}: `at`", at, point.shape))
    return Applied(label, body.name, "force", _axes(label, axes), _value(label, value), point)


def torque(
    body: Body,
    value: Numbers | Callable[..., Array],
    *,
    axes: Literal["world", "body"] = "world",
    name: str | None = None,
) -> Applied:
    """A moment on a body, a number in N m in the plane, (3,) in space, or `value(t, q, v, args)`. Other arguments as those of `force`."""
    label, zero = _on_body("torque", body, name), jnp.zeros(body.dimension)
    return Applied(label, body.name, "torque", _axes(label, axes), _value(label, value), zero)


def _along(kind: str, on: AbstractJoint | Coordinate, name: str | None) -> tuple[str, Coordinate]:
    coordinate = only_coordinate(on)
    return f"{kind} on {on.name}" if name is None else name, coordinate


def _on_body(kind: str, body: Body, name: str | None) -> str:
    if not isinstance(body, Body):
        raise TypeError(f"A {kind} acts on a body, but {brief(body)} is none.")
    return name or f"{kind} on {body.name}"


def _number(label: str, what: str, value: Numbers) -> Float[Array, ""]:
    return numbers(f"Load {label!r}: `{what}`", value, ())


def _axes(label: str, axes: Literal["world", "body"]) -> Literal["world", "body"]:
    if axes not in ("world", "body"):
        raise ValueError(f"Load {label!r}: `axes` must be 'world' or 'body', but is {axes!r}.")
    return axes


def _value(label: str, value: Numbers | Callable[..., Array]) -> Array | Callable[..., Array]:
    return value if callable(value) else numbers(f"Load {label!r}: `value`", value)
