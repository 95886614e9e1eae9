"""Rigid bodies, in the plane and in space, and the ground.

A planar body has the coordinates (x, y, φ) and the mass matrix diag(m, m, J). A spatial body has (x, y, z, e₀, e₁, e₂, e₃), its
centre of mass and a unit quaternion, with the constraint (|e|² − 1)/2 = 0 of its own. With ω = 2 E(e) ė in body axes, the
kinetic energy is extended off the constraint by a term along e, which makes its matrix regular,

    T = m|ṙ|²/2 + ωᵀJ ω/2 + c (eᵀė)²/2,     M = diag(m, m, m, 4 EᵀJ E + c e eᵀ),   c = 4 tr J/3,

and Lagrange's equations of this T, M v̇ = f, have for a moment τ in body axes

    f_e = 2 E(e)ᵀτ − 4 E(ė)ᵀJ ω − c |ė|² e.

As eᵀë = −|ė|² and E e = 0, the terms of c cancel on the constraint: it changes nothing but the multiplier of |e|² = 1, whatever its
size. Source: P. E. Nikravesh, *Computer-Aided Analysis of Mechanical Systems*, ch. 8; A. A. Shabana, *Computational Dynamics*, ch. 7.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from typing_extensions import TypeAliasType

from ..validate.states import brief
from .rotations import cross, matrix, moment, plane, rates, rotate, rotate_back


GROUND = "ground"
# A number or an array of them as a user may write it: (0, -9.81) too. Signatures show the name.
Numbers = TypeAliasType("Numbers", ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]])


class Pose(NamedTuple):
    """Where a body is: its centre of mass, the rotation from body axes to world axes, and in the plane its angle."""

    position: Float[Array, " d"]
    rotation: Float[Array, "d d"]
    angle: Float[Array, ""] | None

    def point(self, local: Float[Array, " d"]) -> Float[Array, " d"]:
        """A point of the body, from body axes to the world."""
        return self.position + rotate(self.rotation, local)

    def local(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """A point of the world, in body axes."""
        return rotate_back(self.rotation, point - self.position)


class Twist(NamedTuple):
    """How a body moves: the velocity of its centre of mass and its angular velocity, a number in the plane, in world axes."""

    velocity: Float[Array, " d"]
    spin: Float[Array, "..."]

    def at(self, arm: Float[Array, " d"]) -> Float[Array, " d"]:
        """The velocity of the point at `arm` from the centre of mass."""
        return self.velocity + cross(self.spin, arm)


class Ground(eqx.Module):
    """What does not move; `mechanisms.ground` is the one there is. Its axes are those of the world."""

    name: str = eqx.field(static=True, default=GROUND)


class Body(eqx.Module):
    """A rigid body. Its place in the reference configuration is where joints and loads find their points on it, and where
    `Mechanism.assemble` starts.

    **Arguments**

    - `name`: what it is called in states, {name: coordinates}.
    - `mass`: in kg, positive.
    - `inertia`: about the centre of mass, in kg m². A number J makes a planar body; the three principal moments, or a symmetric
      positive definite (3, 3) matrix, in body axes, make a spatial one.
    - `at`: the centre of mass in the reference configuration, in m: (2,) or (3,).
    - `orientation`: there, in the plane an angle in rad; in space a quaternion (e₀, e₁, e₂, e₃) of any length.
    - `velocity`, `spin`: of the centre of mass, in m/s, and angular, in rad/s, in world axes: where `assemble` starts.

    Errors: `ValueError` for a mass or an inertia that is not positive, and for numbers that are not real and finite, or of another
    shape.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""]
    inertia: Float[Array, "..."]
    at: Float[Array, " d"]
    orientation: Float[Array, "..."]
    velocity: Float[Array, " d"]
    spin: Float[Array, "..."]

    def __init__(
        self,
        name: str,
        mass: Numbers,
        inertia: Numbers,
        at: Numbers | None = None,
        orientation: Numbers | None = None,
        velocity: Numbers | None = None,
        spin: Numbers | None = None,
    ) -> None:
        if not isinstance(name, str) or not name or name == GROUND:
            raise ValueError(f"A body needs a name that is not {GROUND!r}, but has {name!r}.")
        self.name = name
        given = lambda what, value, *shapes: numbers(f"Body {name!r}: `{what}`", value, *shapes)
        self.mass = given("mass", mass, ())
        self.inertia = given("inertia", inertia, (), (3,), (3, 3))
        if self.inertia.ndim == 1:
            self.inertia = jnp.diag(self.inertia)
        d = self.dimension
        turned, still = (0.0, 0.0) if d == 2 else ([1.0, 0.0, 0.0, 0.0], np.zeros(3))
        self.at = given("at", np.zeros(d) if at is None else at, (d,))
        self.orientation = given("orientation", turned if orientation is None else orientation, np.shape(turned))
        self.velocity = given("velocity", np.zeros(d) if velocity is None else velocity, (d,))
        self.spin = given("spin", still if spin is None else spin, np.shape(still))
        if d == 3:
            length = jnp.sqrt(jnp.sum(self.orientation**2))
            if not isinstance(length, Tracer) and not length > 0:
                raise ValueError(f"Body {name!r}: `orientation` must be a quaternion that is not 0.")
            self.orientation = self.orientation / length
        _refuse_no_mass(self)

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return 2 if self.inertia.ndim == 0 else 3

    @property
    def reference(self) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Coordinates and velocities (q, v) of the reference configuration."""
        if self.dimension == 2:
            join = lambda a, b: jnp.concatenate([a, b[None]])
            return join(self.at, self.orientation), join(self.velocity, self.spin)
        q = jnp.concatenate([self.at, self.orientation])
        return q, velocities(q, self.velocity, self.spin)


def dimension(q: Float[Array, " k"]) -> int:
    """2 of the coordinates of a planar body, 3 of those of a spatial one."""
    return 2 if len(q) == 3 else 3


# Where the bodies of a mechanism are asked for one by one, it would be compiled operation by operation.
@functools.partial(jax.jit, inline=True)
def velocities(q: Float[Array, " k"], velocity: Float[Array, " d"], spin: Float[Array, "..."]) -> Float[Array, " k"]:
    """v at q for a velocity of the centre of mass and an angular velocity in world axes."""
    if dimension(q) == 2:
        return jnp.concatenate([velocity, spin[None]])
    e = q[3:]
    return jnp.concatenate([velocity, rotate_back(rates(e), rotate_back(matrix(e), spin)) / 2])


@functools.partial(jax.jit, inline=True)
def pose(q: Float[Array, " k"]) -> Pose:
    """Where a body is at q."""
    if dimension(q) == 2:
        return Pose(q[:2], plane(q[2]), q[2])
    return Pose(q[:3], matrix(q[3:]), None)


def twist(q: Float[Array, " k"], v: Float[Array, " k"]) -> Twist:
    """How it moves at (q, v)."""
    if dimension(q) == 2:
        return Twist(v[:2], v[2])
    return Twist(v[:3], rotate(matrix(q[3:]), 2 * rotate(rates(q[3:]), v[3:])))


def generalised(
    q: Float[Array, " k"], force: Float[Array, " d"], torque: Float[Array, "..."], arm: Float[Array, " d"]
) -> Float[Array, " k"]:
    """The generalised force of a force that acts at `arm` from the centre of mass and of a moment, all in world axes."""
    torque = torque + moment(arm, force)
    if dimension(q) == 2:
        return jnp.concatenate([force, torque[None]])
    return jnp.concatenate([force, 2 * rotate_back(rates(q[3:]), rotate_back(matrix(q[3:]), torque))])


def wrench(q: Float[Array, " k"], generalised: Float[Array, " k"]) -> tuple[Float[Array, " d"], Float[Array, "..."]]:
    """The force, and the moment about the centre of mass, of a generalised force, in world axes."""
    if dimension(q) == 2:
        return generalised[:2], generalised[2]
    return generalised[:3], rotate(matrix(q[3:]), rotate(rates(q[3:]), generalised[3:]) / 2)


def mass_block(mass: Float[Array, ""], inertia: Float[Array, "..."], q: Float[Array, " k"]) -> Float[Array, "..."]:
    """M of a body: its diagonal in the plane, (7, 7) in space."""
    if dimension(q) == 2:
        return jnp.stack([mass, mass, inertia])
    e = rates(q[3:])
    by_row = jnp.sum(inertia[:, :, None] * e[None, :, :], 1)
    turning = 4 * jnp.sum(e[:, :, None] * by_row[:, None, :], 0) + _along(inertia) * q[3:, None] * q[3:]
    heavy = mass * np.eye(3, dtype=mass.dtype)
    beside = np.zeros((3, 4), mass.dtype)
    return jnp.concatenate([jnp.concatenate([heavy, beside], 1), jnp.concatenate([beside.T, turning], 1)])


def inverse_roots(mass: Float[Array, "..."]) -> Float[Array, " n"]:
    """1/√ of the masses, and of blocks' diagonals: units of coordinates, whatever that of lengths is; 1 of those that are 0."""
    sizes = jnp.ravel(mass if mass.ndim == 1 else jnp.diagonal(mass, axis1=1, axis2=2))
    return jnp.where(sizes > 0, 1 / jnp.sqrt(jnp.where(sizes > 0, sizes, 1)), 1)


def inertial_force(inertia: Float[Array, "..."], q: Float[Array, " k"], v: Float[Array, " k"]) -> Float[Array, " k"]:
    """∂T/∂q − Ṁ v."""
    if dimension(q) == 2:
        return jnp.zeros_like(q)
    e, de = q[3:], v[3:]
    momentum = rotate(inertia, 2 * rotate(rates(e), de))
    turning = -4 * rotate_back(rates(de), momentum) - _along(inertia) * jnp.sum(de**2) * e
    return jnp.concatenate([jnp.zeros(3, q.dtype), turning])


def _along(inertia: Float[Array, "3 3"]) -> Float[Array, ""]:
    """c, of the size of the other eigenvalues of M."""
    return 4 / 3 * jnp.sum(inertia * np.eye(3, dtype=inertia.dtype))


# What bodies are joined to that are joined to the world: it does not move, and its axes are the world's.
ground = Ground()


def ground_row(dimension: int) -> np.ndarray:
    """The coordinates of what does not move and has the world's axes."""
    return np.zeros(3) if dimension == 2 else np.array([0.0, 0, 0, 1, 0, 0, 0])


def reference_row(body: Body | Ground, dimension: int) -> Float[Array, " k"]:
    """The coordinates of a body in the reference configuration."""
    return jnp.asarray(ground_row(dimension)) if isinstance(body, Ground) else body.reference[0]


def reference_pose(body: Body | Ground, dimension: int) -> Pose:
    """Where a body is in the reference configuration."""
    return pose(reference_row(body, dimension))


def numbers(what: str, value: Numbers, *shapes: tuple[int, ...]) -> Array:
    """What a user gives, as an array of floating-point numbers.

    Errors: `ValueError` that says what it is, for what is not real and finite, or of none of these shapes if there are any.
    """
    expected = " or ".join(map(_in_words, shapes)) or "real numbers"
    try:
        # JAX takes a text for the name of a type.
        array = jnp.asarray(None if any(isinstance(x, str | bytes) for x in jax.tree.leaves(value)) else value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be {expected}, but is {brief(value)}.") from None
    if jnp.iscomplexobj(array):
        raise ValueError(f"{what} must be real, but is {brief(value)}.")
    if shapes and array.shape not in shapes:
        raise ValueError(f"{what} must be {expected}, but has the shape {array.shape}.")
    if not isinstance(array, Tracer) and not np.all(np.isfinite(array)):
        raise ValueError(f"{what} is not finite: {np.asarray(array).tolist()}.")
    return array.astype(jnp.result_type(array, float))


def _in_words(shape: tuple[int, ...]) -> str:
    return {0: "a number", 1: f"{shape[0] if shape else 0} numbers"}.get(len(shape), f"a matrix {shape}")


def _refuse_no_mass(body: Body) -> None:
    if not isinstance(body.mass, Tracer) and not np.asarray(body.mass) > 0:
        raise ValueError(f"Body {body.name!r} has the mass {float(body.mass):g}, and must have a positive one.")
    if isinstance(body.inertia, Tracer):
        return
    j = np.atleast_2d(np.asarray(body.inertia))
    moments = np.linalg.eigvalsh(j)
    if not (np.allclose(j, j.T, rtol=0, atol=1e-6 * np.abs(j).max()) and moments[0] > 0):
        raise ValueError(
            f"Body {body.name!r} has the inertia {np.asarray(body.inertia).tolist()}, and must have one that is positive "
            "(symmetric, with positive principal moments); give a thin rod a little about its axis."
        )
    if len(moments) == 3 and moments[2] > (1 + 1e-6) * (moments[0] + moments[1]):
        raise ValueError(
            f"Body {body.name!r} has the principal moments {moments.tolist()}: of no body is one larger than the sum of the others."
        )
