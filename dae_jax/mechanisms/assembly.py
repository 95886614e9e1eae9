"""A consistent start of a mechanism, or which joint cannot close and by how much."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..compiler import quickly_compiled
from ..consistent import consistent_state
from ..systems import ConstrainedSystem
from ..types import Args, Time
from ..validate.states import brief, refuse_wrong_state
from ..validate.user_functions import refuse_wrong_functions
from .bodies import GROUND, inverse_roots, numbers
from .configuration import Coordinate, Coordinates, is_within_half_a_turn
from .contacts import Motion
from .joints import Joint
from .loads import Along
from .outputs import coordinate_named


if TYPE_CHECKING:
    from .mechanism import Mechanism


# What a joint may be open, in parts of the mechanism's size.
CLOSED = 1e-9
# By how much more the joints of a spanning tree count than those that close loops, where not all can be closed.
TREE = 1e4


def assembled(
    mechanism: "Mechanism",
    guess: Any,
    at: Mapping[str, Any],
    rates: Mapping[str, Any],
    t0: Time,
    args: Args,
) -> tuple[Coordinates, Coordinates]:
    """The consistent state nearest to a guess, with these values of coordinates and rates."""
    numbers("`t0`", t0, ())
    start, at, rates = _start(mechanism, guess), _values("at", at), _values("rates", rates)
    coordinates = {name: coordinate_named(mechanism, name) for name in (*at, *rates)}
    # What is wrong with a function is no matter of closing.
    refuse_wrong_functions(mechanism.system(), t0, start, args)
    # Loads neither, which derivatives may be by, while all else is known.
    mechanism = type(mechanism)(mechanism.bodies, mechanism.joints)
    if at.keys() - rates.keys():
        # What has a value and no rate moves as the guess does, or as motors move it: places are found at rest, velocities after them.
        system, rest = (
            _with_values(mechanism, coordinates, at, {}, t0, at_rest=True),
            jax.tree.map(jnp.zeros_like, start[1]),
        )
        start = (_closed(mechanism, system, (start[0], rest), t0, args)[0], start[1])
        at = {name: at[name] for name in at.keys() & rates.keys()}
    found = _closed(mechanism, _with_values(mechanism, coordinates, at, rates, t0), start, t0, args)
    if not isinstance(found[0].values, Tracer):
        for name, is_reversed in _reversed(mechanism, found[0]).items():
            if is_reversed:
                raise ValueError(
                    f"From this guess joint {name!r} closes the wrong way round, its axes against each other: turn the bodies "
                    "of the guess nearer to how they are to be."
                )
    return found


@quickly_compiled
def _reversed(mechanism: "Mechanism", q: Coordinates) -> dict[str, Bool[Array, ""]]:
    """Which lower pairs have closed the wrong way round."""
    at = mechanism.configuration(q)
    return {joint.name: joint.is_reversed(at) for joint in mechanism.joints if isinstance(joint, Joint)}


def _closed(
    mechanism: "Mechanism", system: ConstrainedSystem, start: tuple[Coordinates, Coordinates], t0: Time, args: Args
) -> tuple[Coordinates, Coordinates]:
    try:
        return consistent_state(system, t0, start, args)
    except ValueError as refusal:
        open_by, nearest = _gaps(mechanism, system, t0, start, args)
        scale = 1 + float(jnp.max(jnp.abs(start[0].values)))
        if max(open_by.values(), default=0.0) <= CLOSED * scale:
            # The guess was too far off for Newton's method, and its positions are not: from those closed ones it converges.
            try:
                return consistent_state(system, t0, (nearest, start[1]), args)
            except ValueError:
                raise ValueError(_message({}, 0.0, set())) from refusal
        motors = {joint.name for joint in mechanism.joints if isinstance(joint, Motion)}
        raise ValueError(_message(open_by, CLOSED * scale, motors)) from refusal


def rank(mechanism: "Mechanism", y0: tuple[Coordinates, Coordinates], t0: Time, args: Args) -> tuple[int, int]:
    """The numerical rank of the constraints' Jacobians in coordinates scaled by √mass, so that units do not count, rows of length 1."""
    system = mechanism.system()
    refuse_wrong_state(system, y0)
    q, v = y0
    mechanism.configuration(q, v)
    flat_q, of_q = ravel_pytree(q)
    flat_v, of_v = ravel_pytree(v)
    if isinstance(flat_q, Tracer):
        raise ValueError("`rank` needs a state that is concrete: find it before `vmap` or `jit`, at one design.")
    rows = [np.zeros((0, len(flat_q)))]
    if system.constraint is not None:
        rows.append(np.asarray(jax.jacfwd(lambda x: mechanism.constraint(t0, of_q(x), args))(flat_q)))
    units = np.asarray(inverse_roots(mechanism.mass(q, args)))
    holonomic = _rank(np.concatenate(rows) * units)
    if system.nonholonomic is not None:
        rows.append(np.asarray(jax.jacfwd(lambda x: mechanism.nonholonomic(t0, q, of_v(x), args))(flat_v)))
    return holonomic, _rank(np.concatenate(rows) * units)


def _rank(a: Float[np.ndarray, "m n"]) -> int:
    lengths = np.linalg.norm(a, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(a / np.where(lengths > 0, lengths, 1), rtol=np.finfo(a.dtype).eps ** 0.5))


def _start(mechanism: "Mechanism", guess: Any) -> tuple[Coordinates, Coordinates]:
    q, v = mechanism.reference
    given = guess if isinstance(guess, tuple) else ({} if guess is None else guess, {})
    if len(given) != 2 or not all(isinstance(part, Mapping | Coordinates) for part in given):
        raise TypeError(
            f"`guess` must be coordinates by name, {{{q.names[0]!r}: ...}}, or a pair (q, v) of them, but is {brief(guess)}."
        )
    found = []
    for what, found_so_far, part in zip(("positions", "velocities"), (q, v), given, strict=True):
        if isinstance(part, Coordinates):
            # Of another mechanism with the same bodies the order may be another.
            part = {name: part[name] for name in part.names}
        for name, value in part.items():
            if name not in q.names:
                raise ValueError(f"`guess` has {what} of {name!r}, which is no body; bodies are {', '.join(q.names)}.")
            row = numbers(f"`guess` for the {what} of {name!r}", value, found_so_far[name].shape)
            if what == "positions" and row.size == 7 and not isinstance(row, Tracer) and not np.any(row[3:]):
                raise ValueError(
                    f"`guess` for the positions of {name!r} has the quaternion 0, which is no orientation."
                )
            found_so_far = found_so_far.put(name, row)
        found.append(found_so_far)
    by_name = () if isinstance(given[0], Coordinates) else tuple(given[0])
    return _on_its_side(mechanism, found[0], set(by_name)), found[1]


def _on_its_side(mechanism: "Mechanism", q: Coordinates, chosen: set[str]) -> Coordinates:
    """Of e and −e, which are one orientation, springs of angles know one as less than half a turn: that is taken of the bodies whose
    quaternions are `chosen` by hand, one after the other.
    """
    springs = [load.coordinate for load in mechanism.loads if isinstance(load, Along) and load.counts_turns]
    known = {GROUND, *q.names} - chosen
    while found := [c for c in springs if (c.on_a.body in known) != (c.on_b.body in known)]:
        (c, *_) = found
        new = c.on_a.body if c.on_b.body in known else c.on_b.body
        at = mechanism.configuration(q)
        row_a, row_b = (at.rows[at.row(on.body)] for on in (c.on_a, c.on_b))
        fine = is_within_half_a_turn(row_a, row_b, c.on_a.reference, c.on_b.reference)
        row = q[new]
        q, known = q.put(new, jnp.where(fine, row, row.at[3:].multiply(-1))), known | {new}
    return q


def _with_values(
    mechanism: "Mechanism",
    coordinates: dict[str, Coordinate],
    at: dict[str, Array],
    rates: dict[str, Array],
    t0: Time,
    at_rest: bool = False,
) -> ConstrainedSystem:
    """The mechanism's equations and those that fix values of coordinates and rates; `at_rest`, those of places in time's standstill."""
    system = mechanism.system()
    if not at and not rates:
        return system
    held = _Held(mechanism, coordinates, at, rates, jnp.asarray(t0), at_rest)
    has_rates = not at_rest and (system.nonholonomic is not None or set(rates) - set(at))
    has_positions = system.constraint is not None or at
    return ConstrainedSystem(
        system.force,
        held.constraint if has_positions else None,
        system.mass,
        held.nonholonomic if has_rates else None,
    )


def _values(what: str, given: Mapping[str, Any]) -> dict[str, Array]:
    if not isinstance(given, Mapping):
        raise TypeError(f"`{what}` must be values by name, {{'crank': 0.3}}, but is {brief(given)}.")
    return {name: numbers(f"`{what}` of {name!r}", value, ()) for name, value in given.items()}


class _Held(eqx.Module):
    """A mechanism whose coordinates have these values at t₀, and move on from them at these rates. A module, so that `jit` and
    derivatives find the numbers in it.
    """

    mechanism: "Mechanism"
    coordinates: dict[str, Coordinate]
    at: dict[str, Array]
    rates: dict[str, Array]
    t0: Array
    at_rest: bool = eqx.field(static=True)

    def constraint(self, t: Time, q: Coordinates, args: Args) -> Array:
        """The mechanism's equations of positions, and c − c₀ − ċ₀ (t − t₀)."""
        t = jnp.asarray(self.t0, q.values.dtype) if self.at_rest else t
        configuration = self.mechanism.configuration(q)
        wanted = {name: c + self.rates.get(name, 0.0) * (t - self.t0) for name, c in self.at.items()}
        extra = [self.coordinates[name].off(configuration, c) for name, c in wanted.items()]
        return jnp.concatenate([self.mechanism.constraint(t, q, args), *(jnp.reshape(x, 1) for x in extra)])

    def nonholonomic(self, t: Time, q: Coordinates, v: Coordinates, args: Args) -> Array:
        """Those of velocities, and ċ − ċ₀ of what has a rate and no value."""
        configuration, free = self.mechanism.configuration(q, v), self.rates.keys() - self.at.keys()
        extra = [self.coordinates[name].with_rate(configuration)[1] - self.rates[name] for name in sorted(free)]
        return jnp.concatenate([self.mechanism.nonholonomic(t, q, v, args), *(jnp.reshape(x, 1) for x in extra)])


def _gaps(
    mechanism: "Mechanism", system: ConstrainedSystem, t0: Time, start: tuple[Coordinates, Coordinates], args: Args
) -> tuple[dict[str, float], Coordinates]:
    """What each joint is open by where those that close a loop are closed as far as the others, which are, allow; and where that is."""
    from scipy.optimize import least_squares

    flat, unflatten = ravel_pytree(start[0])
    constraint = system.constraint
    if constraint is None:
        return {}, start[0]
    g = jax.jit(lambda x: jnp.ravel(constraint(t0, unflatten(x), args)))
    slope = jax.jit(jax.jacfwd(g))
    rows, closing = mechanism.rows(), _closing(mechanism)
    in_time = jax.jacfwd(lambda t: jnp.ravel(constraint(t, start[0], args)))(jnp.asarray(t0, flat.dtype))
    at_start = np.column_stack([g(flat), in_time, slope(flat)])
    for name, (g_rows, _) in rows.items():
        if not np.all(np.isfinite(at_start[g_rows])):
            raise ValueError(
                f"The equations of joint {name!r}, or their derivatives, are not finite at this guess, as those of a wheel that lies "
                "on its plane, or of a motion that begins like √t."
            )
    weights = np.full(len(at_start), TREE)
    for name in closing:
        weights[rows[name][0]] = 1.0
    found = least_squares(
        lambda x: weights * np.asarray(g(x)),
        np.asarray(flat),
        lambda x: weights[:, None] * np.asarray(slope(x)),  # pyright: ignore[reportArgumentType]
        method="trf",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=500,
    )
    left = np.asarray(g(found.x))
    gaps = {name: float(np.linalg.norm(left[g_rows])) for name, (g_rows, _) in rows.items() if g_rows}
    return gaps, unflatten(jnp.asarray(found.x, flat.dtype))


def _closing(mechanism: "Mechanism") -> list[str]:
    """The joints that join what other joints, listed before them, have joined already."""
    leader = {name: name for name in (GROUND, *(body.name for body in mechanism.bodies))}

    def find(name: str) -> str:
        while leader[name] != name:
            name = leader[name]
        return name

    closing = []
    for joint in mechanism.joints:
        a, b = find(joint.on_a.body), find(joint.on_b.body)
        if a == b:
            closing.append(joint.name)
        leader[a] = b
    return closing


def _message(gaps: dict[str, float], allowed: float, motors: set[str]) -> str:
    still_open = sorted(((gap, name) for name, gap in gaps.items() if gap > allowed), reverse=True)
    if not still_open:
        return (
            "All joints close, but no velocities fit them: the values in `rates` contradict the joints (of a mechanism that cannot "
            "move they are 0), or a motor moves what cannot move."
        )
    gap, worst = still_open[0]
    others = "".join(f"\n  {name!r} by {gap:.6g}" for gap, name in still_open[1:])
    if worst in motors:
        return (
            f"The mechanism cannot be assembled from this guess: motor {worst!r} is off its motion by {gap:.6g} when all joints are closed "
            "(m, or rad of an angle). A value in `at` contradicts `motion(t0, args)`, or the joints do not let it get there."
            + (f"\nAlso off:{others}" if others else "")
        )
    return (
        f"The mechanism cannot be assembled from this guess: joint {worst!r} stays open by {gap:.6g} when all others are closed as "
        "far as they can be (m, or rad of an angle). Bodies are too short or too long for this loop, or the guess is "
        "too far off." + (f"\nAlso open:{others}" if others else "")
    )
