"""What a mechanism's solution shows: coordinates, efforts, reactions, power; of a batch of solutions with the batch's axes first."""

import functools
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .. import diagnostics, solution
from ..solution import AccuracyWarning, DAESolution
from ..types import Args, State, Time
from ..validate.captured import current
from .bodies import GROUND, wrench
from .configuration import Configuration, Coordinate, Coordinates
from .contacts import Motion
from .loads import AbstractLoad, Along
from .paths import LEADING
from .refusals import refuse_no_solution
from .rotations import moment, rotate_back


if TYPE_CHECKING:
    from .mechanism import Mechanism


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
    if not c.is_turn:
        return _at_saved_times((mechanism, c), sol, _value)
    values, rates = _at_saved_times((mechanism, c), sol, _with_rate)
    _doubt_turns(name, sol.ts, rates)
    return jnp.unwrap(values)


def _doubt_turns(name: str, ts: Float[Array, "*batch times"], rates: Float[Array, "*batch times"]) -> None:
    """Warns of times at both of which an angle in space turns, the same way, by half a turn or more until the other."""
    if isinstance(rates, Tracer) or rates.shape[-1] < 2:
        return
    times, speeds = np.asarray(ts), np.asarray(rates)
    # What is saved at steps is filled up with infinite times.
    with np.errstate(invalid="ignore"):
        spans = np.where(np.isfinite(times[..., 1:]), np.diff(times), 0)
    turns = spans * np.stack([speeds[..., :-1], speeds[..., 1:]])
    fast = np.min(np.abs(turns), 0) * (turns[0] * turns[1] > 0)
    if np.any(fast >= np.pi):
        worst = np.unravel_index(np.nanargmax(fast), fast.shape)
        span = [f"{float(times[(*worst[:-1], worst[-1] + k)]):.6g}" for k in (0, 1)]
        warnings.warn(
            f"Whole turns of {name!r}, an angle in space, are not known: between the saved times {' and '.join(span)} it turns by about "
            f"{fast[worst]:.3g} rad, as fast as it is there. Save more times.",
            AccuracyWarning,
            stacklevel=4,
        )


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
            return -multipliers(mechanism, sol)[..., row]
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
    every, rows = multipliers(mechanism, sol), mechanism.rows()
    holonomic = every.shape[-1] - sum(len(h) for _, h in rows.values())
    g_rows, h_rows = rows[name]
    lam, mu = every[..., jnp.array(g_rows, int)], every[..., jnp.array(h_rows, int) + holonomic]
    return at_saved_times(sol, functools.partial(_reaction, axes=axes), (mechanism, joint), lam, mu)


def multipliers(mechanism: "Mechanism", sol: DAESolution) -> Float[Array, "*batch times mp"]:
    """(λ, μ) at each saved time."""
    refuse_no_solution(mechanism, sol)
    return diagnostics.multipliers(mechanism.system(), sol)


def energy(mechanism: "Mechanism", sol: DAESolution) -> Float[Array, " times"]:
    """T + V."""
    return diagnostics.energy(mechanism.system(), sol)


def power(mechanism: "Mechanism", sol: DAESolution) -> dict[str, Float[Array, " times"]]:
    """Q·v of each load without a potential and of what leads."""
    refuse_no_solution(mechanism, sol)
    at_start = mechanism.configuration(*mechanism.reference)
    found = {
        load.name: _at_saved_times((mechanism, load), sol, _work)
        for load in mechanism.loads
        if load.energy(at_start) is None
    }
    for joint in mechanism.joints:
        if isinstance(joint, LEADING):
            lam = multipliers(mechanism, sol)[..., jnp.array(mechanism.rows()[joint.name][0], int)]
            found[joint.name] = at_saved_times(sol, _leading_work, (mechanism, joint), lam)
    return found


def _reaction(what: Any, t: Time, y: Any, lam: Array, mu: Array, args: Args, axes: str) -> tuple[Array, Array]:
    (mechanism, joint), (q, v) = what, y
    at = mechanism.configuration(q, v)
    held = _pull(lambda q: joint.constraint(t, mechanism.configuration(q), args), q, lam)
    rolled = _pull(lambda v: joint.nonholonomic(t, mechanism.configuration(q, v), args), v, mu)
    # Of a joint on the ground, the ground is what the first body acts on.
    on, sign = (joint.on_b, 1.0) if joint.on_b.body != GROUND else (joint.on_a, -1.0)
    generalised = -held[on.body] - rolled[on.body]
    force, torque = wrench(q[on.body], generalised)
    arm = joint.on_b.position(at) - at.pose(on.body).position
    force, torque = sign * force, sign * (torque - moment(arm, force))
    if axes == "body":
        turn = at.pose(joint.on_b.body).rotation
        return rotate_back(turn, force), rotate_back(turn, torque) if torque.ndim else torque
    return force, torque


def _leading_work(what: Any, t: Time, y: tuple[Coordinates, Coordinates], lam: Array, args: Args) -> Array:
    """−λ·(∂l/∂q) v, of what leads by l(t, q) = 0."""
    (mechanism, joint), (q, v) = what, y
    pull = _pull(lambda q: joint.constraint(t, mechanism.configuration(q), args), q, lam)
    return -jnp.sum(pull.values * v.values)


def _pull(equations: Callable[[Coordinates], Array], at: Coordinates, multipliers: Array) -> Coordinates:
    """(∂e/∂x)ᵀ λ of equations e(x); these have more digits than x and λ where the mechanism's numbers do."""
    e, pull = jax.vjp(equations, at)
    return pull(multipliers.astype(e.dtype))[0]


def _work(load: AbstractLoad, t: Time, at: Configuration, args: Args) -> Array:
    assert at.v is not None
    return jnp.sum(load.generalised_force(t, at, args) * at.v.values)


_value = lambda c, t, at, args: c(at)
_rate = lambda c, t, at, args: c.with_rate(at)[1]
_with_rate = lambda c, t, at, args: c.with_rate(at)
_effort = lambda load, t, at, args: load.effort(t, at, args)


def at_saved_times(sol: DAESolution, of: Callable[..., Any], what: tuple["Mechanism", Any], *more: Array) -> Any:
    """of(what, t, y, *more, args) at each saved time, for a mechanism and parts of it; of a batch of solutions, of each. `more` has
    the axes of `sol.ts`.
    """
    refuse_no_solution(what[0], sol)
    of, what = current(of), current(what)

    def along(ts: Float[Array, "*batch times"], ys: State, args: Args, changed: Args, *more: Array) -> Any:
        if ts.ndim > 1:
            return eqx.filter_vmap(along)(ts, ys, args, changed, *more)
        return solution.at_saved_times(of, what, ts, ys, args, changed, *more)

    return along(*solution.saved_arrays(sol), *more)


def _at_saved_times(
    what: tuple["Mechanism", Any], sol: DAESolution, of: Callable[[Any, Time, Configuration, Args], Any]
) -> Any:
    """of(part, t, configuration, args) at each saved time, for a mechanism and a part of it."""
    return at_saved_times(sol, functools.partial(_of_part, of), what)


def _of_part(
    of: Callable[..., Any], what: tuple["Mechanism", Any], t: Time, y: tuple[Coordinates, Coordinates], args: Args
) -> Any:
    mechanism, part = what
    return of(part, t, mechanism.configuration(*y), args)
