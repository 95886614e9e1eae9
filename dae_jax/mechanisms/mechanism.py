"""Bodies, joints and loads as one `ConstrainedSystem`."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..scenes.scene import Drawing
from ..solution import DAESolution
from ..systems import ConstrainedSystem
from ..types import Args, Scalar, Time
from ..validate.states import brief
from . import assembly, outputs
from .bodies import Body, inertial_force, mass_block
from .configuration import Configuration, Coordinates
from .drawing import drawing
from .interface import AbstractJoint
from .inverse_dynamics import inverse_dynamics
from .joints import Joint, pairs
from .loads import AbstractLoad, Along, along
from .refusals import refuse_other_bodies, refuse_what_does_not_fit


class Mechanism(eqx.Module):
    """Rigid bodies, the joints between them and the loads on them, all in the plane or all in space.

    Its states are pairs (q, v) of `Coordinates` and their derivatives: q["crank"] is (x, y, φ) of a body in the plane, and
    (x, y, z, e₀, e₁, e₂, e₃) in space, see `Body`. It is a pytree whose leaves are masses, inertias, points, stiffnesses and so
    on: `jax.grad` and `jax.vmap` go through a function that makes a mechanism from a design and solves it. What is shown of a
    solution is an array over its saved times, in which the last value goes on beyond the end of a solve that stopped early.

    **Arguments**

    - `bodies`: of `Body`.
    - `joints`: of `revolute`, `prismatic`, `cylindrical`, `spherical`, `universal`, `planar`, `fixed`, `distance`,
      `point_on_curve`, `point_on_path`, `rolling`. Loops may be closed in any way; equations that are redundant then are found by
      `daesolve`.
    - `loads`: of `gravity`, `spring`, `damper`, `friction`, `motor`, `force`, `torque`.

    Errors: `ValueError` for names that occur twice or are not there, and for bodies in the plane beside ones in space.
    """

    bodies: tuple[Body, ...]
    joints: tuple[AbstractJoint, ...]
    loads: tuple[AbstractLoad, ...]

    def __init__(
        self,
        bodies: Sequence[Body],
        joints: Sequence[AbstractJoint] = (),
        loads: Sequence[AbstractLoad | AbstractJoint] = (),
    ) -> None:
        for name, listed in (("bodies", bodies), ("joints", joints), ("loads", loads)):
            if not isinstance(listed, Sequence) or isinstance(listed, str):
                raise TypeError(f"`{name}` must be a list, but is {brief(listed)}: write {name}=[...].")
        given = (*joints, *loads)
        self.bodies = tuple(bodies)
        # A motor whose motion is given is an equation, whatever list it is in.
        self.joints = tuple(x for x in given if isinstance(x, AbstractJoint))
        self.loads = tuple(x for x in given if isinstance(x, AbstractLoad))
        refuse_what_does_not_fit(self, given)

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return self.bodies[0].dimension

    def configuration(self, q: Coordinates, v: Coordinates | None = None) -> Configuration:
        """All bodies at one instant."""
        for part in (q,) if v is None else (q, v):
            refuse_other_bodies(self, part)
        return Configuration(self.bodies, q, v)

    # The equations

    def force(self, t: Time, q: Coordinates, v: Coordinates, args: Args) -> Coordinates:
        """f of M v̇ = f − Gᵀλ − Hᵀμ: all loads, and the inertial forces of turning bodies."""
        at = self.configuration(q, v)
        total = (
            jnp.zeros_like(q.values)
            if self.dimension == 2
            else jax.vmap(inertial_force)(at.inertias, q.values, v.values)
        )
        springs = [load for load in self.loads if isinstance(load, Along)]
        for kind in sorted({load.coordinate.kind for load in springs}):
            total = total + along([load for load in springs if load.coordinate.kind == kind], t, at, args)
        for load in self.loads:
            if not isinstance(load, Along):
                total = total + load.generalised_force(t, at, args)
        return Coordinates(total, q.names)

    def not_finite_loads(self, t: Time, q: Coordinates, v: Coordinates, args: Args) -> list[str]:
        """The loads that are NaN or infinite at a state, and why where that is known; errors of a solve say so."""
        at = self.configuration(q, v)
        lost = [load for load in self.loads if not jnp.all(jnp.isfinite(load.generalised_force(t, at, args)))]
        half_a_turn = ", whose angle in space has come to half a turn: its turns are not known beyond"
        return [f"{load.name!r}{half_a_turn * (isinstance(load, Along) and load.counts_turns)}" for load in lost]

    def constraint(self, t: Time, q: Coordinates, args: Args) -> Float[Array, " m"]:
        """g: the equations of lower pairs in their order, then those of other joints, then |e|² = 1 of each body in space."""
        at = self.configuration(q)
        rows = [pairs(self._pairs, at), *(joint.constraint(t, at, args) for joint in self._others)]
        if self.dimension == 3:
            rows.append((jnp.sum(q.values[:, 3:] ** 2, 1) - 1) / 2)
        return jnp.concatenate(rows)

    @property
    def _pairs(self) -> list[Joint]:
        return [joint for joint in self.joints if isinstance(joint, Joint)]

    @property
    def _others(self) -> list[AbstractJoint]:
        return [joint for joint in self.joints if not isinstance(joint, Joint)]

    def nonholonomic(self, t: Time, q: Coordinates, v: Coordinates, args: Args) -> Float[Array, " p"]:
        """h, of what rolls."""
        at = self.configuration(q, v)
        return jnp.concatenate(
            [jnp.zeros(0, v.values.dtype), *(joint.nonholonomic(t, at, args) for joint in self._others)]
        )

    def potential(self, q: Coordinates, args: Args) -> Scalar:
        """V, of gravity and springs."""
        at = self.configuration(q)
        parts = [energy for load in self.loads if (energy := load.energy(at)) is not None]
        return sum(parts, jnp.zeros((), q.values.dtype))

    def mass(self, q: Coordinates, args: Args = None) -> Float[Array, "..."]:
        """M: its diagonal in the plane, its blocks (bodies, 7, 7) in space."""
        at = self.configuration(q)
        blocks = jax.vmap(mass_block)(at.masses, at.inertias, q.values)
        return jnp.ravel(blocks) if self.dimension == 2 else blocks

    def system(self, rank: int | tuple[int, int] | None = None) -> ConstrainedSystem:
        """The equations as `daesolve` takes them; `rank` as that of `ConstrainedSystem`, which only a start that is traced needs
        where equations are redundant: `Mechanism.rank` finds it.

        Errors: `ValueError` in the plane without a joint.
        """
        position, velocity = self._shapes()
        if self.dimension == 2 and not sum(position) + sum(velocity):
            bodies = ", ".join(body.name for body in self.bodies)
            raise ValueError(
                f"Nothing constrains this mechanism (bodies: {bodies}): in the plane it needs a joint. Without one its motion is an ODE, "
                "v̇ = force / mass, which `diffrax.diffeqsolve` solves."
            )
        return ConstrainedSystem(
            self.force,
            self.constraint if sum(position) or self.dimension == 3 else None,
            self.mass if self.dimension == 3 else self.mass(self.reference[0]),
            self.nonholonomic if sum(velocity) else None,
            self.potential,
            rank,
        )

    def _shapes(self) -> tuple[list[int], list[int]]:
        """How many equations each joint has, of positions and of velocities."""
        found: list[tuple[int, int]] = []
        jax.eval_shape(
            lambda q, v: found.extend(joint.counts(self.configuration(q, v)) for joint in self.joints), *self.reference
        )
        return [g for g, _ in found], [h for _, h in found]

    def rows(self) -> dict[str, tuple[list[int], list[int]]]:
        """{joint: its rows in `constraint` and in `nonholonomic`}."""
        shapes = dict(zip((joint.name for joint in self.joints), zip(*self._shapes(), strict=True), strict=True))
        found, ends = {}, [0, 0]
        for joint in (*self._pairs, *self._others):
            counts = shapes[joint.name]
            found[joint.name] = tuple(list(range(end, end + k)) for end, k in zip(ends, counts, strict=True))
            ends = [end + k for end, k in zip(ends, counts, strict=True)]
        return found

    # States

    @property
    def reference(self) -> tuple[Coordinates, Coordinates]:
        """(q, v) of the reference configuration, as the bodies have it: consistent or not."""
        names = tuple(body.name for body in self.bodies)
        q, v = (jnp.stack(x) for x in zip(*(body.reference for body in self.bodies), strict=True))
        return Coordinates(q, names), Coordinates(v, names)

    def assemble(
        self,
        guess: Mapping[str, Any] | tuple[Mapping[str, Any], Mapping[str, Any]] | None = None,
        *,
        at: Mapping[str, Any] | None = None,
        rates: Mapping[str, Any] | None = None,
        t0: Time = 0.0,
        args: Args = None,
    ) -> tuple[Coordinates, Coordinates]:
        """The state (q, v) nearest to a guess in which all joints are closed and all velocities fit.

        **Arguments**

        - `guess`: coordinates by name, or a pair (q, v) of them; of bodies that are left out, those of the reference configuration.
          Quaternions may have any length, and either sign, of which that is taken in which springs of angles have their value.
        - `at`, `rates`: values of joints' coordinates, and of their rates, by the joints' names ("joint.angle" where one has
          several): {"crank": 0.3}. What has a value and no rate moves as the guess does.
        - `t0`, `args`: for joints that depend on them.

        Errors: `ValueError` where the mechanism cannot be assembled: which joint stays open, and by how much. NaN where the
        arguments are traced.
        """
        return assembly.assembled(self, guess, at or {}, rates or {}, t0, args)

    def rank(self, y0: tuple[Coordinates, Coordinates], t0: Time = 0.0, args: Args = None) -> tuple[int, int]:
        """How many equations are independent at a state that is concrete: of positions, and in all."""
        return assembly.rank(self, y0, t0, args)

    # What a solution shows, at each saved time

    def coordinate(self, sol: DAESolution, name: str) -> Float[Array, " times"]:
        """The angle, displacement or distance along which a joint, a spring or a motor acts ("joint.angle" where there are several).
        An angle in space is continuous from one saved time to the next, if it turns by less than π between them; an `AccuracyWarning`
        says where it is too fast for that.
        """
        return outputs.coordinate(self, sol, name)

    def rate(self, sol: DAESolution, name: str) -> Float[Array, " times"]:
        """The time derivative of `coordinate`."""
        return outputs.rate(self, sol, name)

    def effort(self, sol: DAESolution, name: str) -> Float[Array, " times"]:
        """The torque in N m, or force in N, of a motor, a spring, a damper or friction; of a motor whose motion is given, what it
        takes.
        """
        return outputs.effort(self, sol, name)

    def reaction(
        self, sol: DAESolution, name: str, axes: Literal["world", "body"] = "world"
    ) -> tuple[Float[Array, "times d"], Float[Array, "times *d"]]:
        """Force in N and moment in N m by which a joint acts on its second body, at that body's point of the joint; a moment is a
        number in the plane. `axes`: the world's or that body's. Where equations are redundant the forces are not unique, and
        those of least norm of the multipliers are given.
        """
        return outputs.reaction(self, sol, name, axes)

    def inverse_dynamics(self, sol: DAESolution, motors: Sequence[str]) -> dict[str, Float[Array, " times"]]:
        """The efforts by which motors on the named joints ("joint.angle" where one has several) do what leads the mechanism, in place
        of its `point_on_path` and `motor(..., motion=...)`: torques in N m, forces in N. All other loads stay, and efforts of motors
        that have a torque come on top. With more motors than degrees of freedom those of least norm are given.

        Errors: `ValueError` where such motors cannot do it; NaN where the arguments are traced.
        """
        return inverse_dynamics(self, sol, motors)

    def drawing(self) -> Drawing:
        """Centres of mass, joints and springs as points, (points, 2) or (points, 3), and the lines between them."""
        return drawing(self)

    def energy(self, sol: DAESolution) -> Float[Array, " times"]:
        """Kinetic and potential energy, in J."""
        return outputs.energy(self, sol)

    def power(self, sol: DAESolution) -> dict[str, Float[Array, " times"]]:
        """What each load that has no potential, each motor whose motion is given and each path of a point puts in, in W: their sum
        is the derivative of `energy`.
        """
        return outputs.power(self, sol)
