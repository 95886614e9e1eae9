"""What a mechanism's solution shows: coordinates, efforts, reactions, power."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .. import diagnostics, solution
from ..solution import DAESolution, without_padding
from ..types import Args, Time
from ..validate.captured import current
from .bodies import GROUND, wrench
from .configuration import Configuration, Coordinate, Coordinates
from .contacts import Coupling, Motion
from .joints import AbstractJoint
from .loads import AbstractLoad, Along, Applied
from .paths import LEADING
from .rotations import moment, rotate_back


if TYPE_CHECKING:
    from .mechanism import Mechanism


def bodies_of(element: AbstractJoint | AbstractLoad) -> set[str]:
    """The bodies that a joint or a load names."""
    if isinstance(element, Applied):
        return {element.body}
    on = [element.coordinate if isinstance(element, Along) else element]
    if isinstance(element, Coupling):
        on += [element.first, element.second]
    return {x.body for part in on if isinstance(part, AbstractJoint | Coordinate) for x in (part.on_a, part.on_b)}


def coordinate_named(mechanism: "Mechanism", name: str) -> Coordinate:
    """That of a joint or a load, "joint.angle" where a joint has several."""
    along = {load.name: load.coordinate for load in mechanism.loads if isinstance(load, Along)}
    known: dict[str, Coordinate] = dict(along)
    for joint in mechanism.joints:
        found = joint.coordinates
        known |= {f"{joint.name}.{kind}": c for kind, c in found.items()}
        if len(found) == 1:
            known |= {joint.name: next(iter(found.values()))}
    if name not in known:
        raise ValueError(f"There is no coordinate {name!r}; there are {', '.join(map(repr, known)) or 'none'}.")
    return known[name]


def coordinate(mechanism: "Mechanism", sol: DAESolution, name: str) -> Float[Array, " times"]:
    """c at each saved time."""
    c = coordinate_named(mechanism, name)
    values = _at_saved_times((mechanism, c), sol, _value)
    return jnp.unwrap(values) if c.kind == "angle" and mechanism.dimension == 3 else values


def rate(mechanism: "Mechanism", sol: DAESolution, name: str) -> Float[Array, " times"]:
    """ċ at each saved time."""
    c = coordinate_named(mechanism, name)
    return _at_saved_times((mechanism, c), sol, _rate)


def effort(mechanism: "Mechanism", sol: DAESolution, name: str) -> Float[Array, " times"]:
    """τ at each saved time."""
    for load in mechanism.loads:
        if load.name == name and isinstance(load, Along):
            return _at_saved_times((mechanism, load), sol, _effort)
    for joint in mechanism.joints:
        if joint.name == name and isinstance(joint, Motion):
            (row,), _ = mechanism.rows()[name]
            # g grows with c at the rate 1 where it is 0, and pulls by −λ.
            return -diagnostics.multipliers(mechanism.system(), sol)[..., row]
    known = [x.name for x in (*mechanism.loads, *mechanism.joints) if isinstance(x, Along | Motion)]
    raise ValueError(
        f"There is no motor, spring or damper {name!r}; there are {', '.join(map(repr, known)) or 'none'}."
    )


def reaction(
    mechanism: "Mechanism", sol: DAESolution, name: str, axes: Literal["world", "body"]
) -> tuple[Float[Array, "times d"], Float[Array, "times *d"]]:
    """Force and moment on the second body of a joint, at its point there."""
    joint = next((joint for joint in mechanism.joints if joint.name == name), None)
    if joint is None:
        raise ValueError(f"There is no joint {name!r}; there are {', '.join(repr(j.name) for j in mechanism.joints)}.")
    if axes not in ("world", "body"):
        raise ValueError(f"`axes` must be 'world' or 'body', but is {axes!r}.")
    multipliers, rows = diagnostics.multipliers(mechanism.system(), sol), mechanism.rows()
    holonomic = multipliers.shape[-1] - sum(len(h) for _, h in rows.values())
    g_rows, h_rows = rows[name]
    lam, mu = multipliers[..., jnp.array(g_rows, int)], multipliers[..., jnp.array(h_rows, int) + holonomic]
    return at_saved_times(sol, functools.partial(_reaction, axes=axes), (mechanism, joint), lam, mu)


def leading_force(mechanism: "Mechanism", sol: DAESolution, name: str) -> Float[Array, "times bodies k"]:
    """−(∂l/∂q)ᵀ λ, the generalised force on all bodies of what leads by l(t, q) = 0."""
    joint = next(joint for joint in mechanism.joints if joint.name == name)
    lam = diagnostics.multipliers(mechanism.system(), sol)[..., jnp.array(mechanism.rows()[name][0], int)]
    return at_saved_times(sol, _leading_force, (mechanism, joint), lam)


def energy(mechanism: "Mechanism", sol: DAESolution) -> Float[Array, " times"]:
    """T + V."""
    return diagnostics.energy(mechanism.system(), sol)


def power(mechanism: "Mechanism", sol: DAESolution) -> dict[str, Float[Array, " times"]]:
    """Q·v of each load without a potential and of what leads."""
    at_start = mechanism.configuration(*mechanism.reference)
    found = {
        load.name: _at_saved_times((mechanism, load), sol, _work)
        for load in mechanism.loads
        if load.energy(at_start) is None
    }
    for joint in mechanism.joints:
        if isinstance(joint, LEADING):
            work = leading_force(mechanism, sol, joint.name) * without_padding(sol.ts, sol.ys)[1][1].values
            found[joint.name] = jnp.sum(work, (1, 2))
    return found


def _reaction(what: Any, t: Time, y: Any, lam: Array, mu: Array, args: Args, axes: str) -> tuple[Array, Array]:
    (mechanism, joint), (q, v) = what, y
    at = mechanism.configuration(q, v)
    _, pull = jax.vjp(lambda q: joint.constraint(t, mechanism.configuration(q), args), q)
    _, pull_v = jax.vjp(lambda v: joint.nonholonomic(t, mechanism.configuration(q, v), args), v)
    # Of a joint on the ground, the ground is what the first body acts on.
    on, sign = (joint.on_b, 1.0) if joint.on_b.body != GROUND else (joint.on_a, -1.0)
    generalised = -pull(lam)[0][on.body] - pull_v(mu)[0][on.body]
    force, torque = wrench(q[on.body], generalised)
    arm = joint.on_b.position(at) - at.pose(on.body).position
    force, torque = sign * force, sign * (torque - moment(arm, force))
    if axes == "body":
        turn = at.pose(joint.on_b.body).rotation
        return rotate_back(turn, force), rotate_back(turn, torque) if torque.ndim else torque
    return force, torque


def _leading_force(what: Any, t: Time, y: tuple[Coordinates, Coordinates], lam: Array, args: Args) -> Array:
    mechanism, joint = what
    _, pull = jax.vjp(lambda q: joint.constraint(t, mechanism.configuration(q), args), y[0])
    return -pull(lam)[0].values


def _work(load: AbstractLoad, t: Time, at: Configuration, args: Args) -> Array:
    assert at.v is not None
    return jnp.sum(load.generalised_force(t, at, args) * at.v.values)


_value = lambda c, t, at, args: c(at)
_rate = lambda c, t, at, args: c.with_rate(at)[1]
_effort = lambda load, t, at, args: load.effort(t, at, args)


def at_saved_times(sol: DAESolution, of: Callable[..., Any], what: PyTree, *more: Array) -> Any:
    """of(what, t, y, *more, args) at each saved time; `more` has these along its first axis."""
    return solution.at_saved_times(current(of), current(what), sol.ts, sol.ys, sol.args, sol.changed, *more)


def _at_saved_times(
    what: tuple["Mechanism", Any], sol: DAESolution, of: Callable[[Any, Time, Configuration, Args], Array]
) -> Float[Array, " times"]:
    """of(part, t, configuration, args) at each saved time, for a mechanism and a part of it."""
    return at_saved_times(sol, functools.partial(_of_part, of), what)


def _of_part(
    of: Callable[..., Array], what: tuple["Mechanism", Any], t: Time, y: tuple[Coordinates, Coordinates], args: Args
) -> Array:
    mechanism, part = what
    return of(part, t, mechanism.configuration(*y), args)
