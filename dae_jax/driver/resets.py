"""Solves that start again: where a condition crosses zero, the state or the equations change."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from .._compat import while_loop
from ..compiler import one_kernel
from ..compiler.types import Arrays
from ..consistent import consistent_after
from ..equations.raised_index import may_be_raised
from ..solution import RESULTS, DAESolution, Split, last_saved, precision_of
from ..systems import System, is_mechanism
from ..types import Args, BoolScalar, Scalar, State, Time
from ..validate.states import NUMBERS, brief
from .bracket import Bracket
from .ends import Start
from .known_derivatives import refused_if_unknown
from .problem import Problem, count_of, split
from .reset_levels import FromStart, error_of, level_at_start
from .start import saved_parts
from .tolerances import of_state


if TYPE_CHECKING:
    from .program import Solve


# Entries of `stats` that do not add up over the parts of a solve.
NO_COUNTS = ("max_steps", "end_time")
# A condition may be on its way off zero for no more than this part of the solve's interval.
SAME = 1e-3


class Reset(eqx.Module):
    """An `event` after which the solve goes on: a stop that is hit, a diode that switches.

    **Arguments**

    - `condition(t, y, args, **kwargs)`: a real number; an event is where it crosses zero, located on the solver's dense
      output.
    - `reset(t, y, args) -> (y, args)`: the state and the `args` that the solve goes on with. The nearest consistent state to
      it is taken, in the sense of `consistent_state`; of a `SemiExplicitDAE` or an `ImplicitDAE` variables whose derivative occurs in
      the equations keep what they are set to, if the others (multipliers, currents) can be consistent with them.
    - `direction`: `True` for upcrossings only, `False` for downcrossings only, in the direction in which the solve goes.
    - `fixed`: entries of the state that are kept when it is made consistent, as in `consistent_state`.
    - `max_resets`: how many there may be; one more ends the solve with `RESULTS.too_many_jumps`, and so do resets that pile
      up at one time.

    A solve with a `Reset` saves what `SaveAt(t0=..., ts=..., t1=..., fn=...)` asks for: at the time of a reset, the state
    after it. `sol.stats["jumps"]` counts them, `sol.stats["jump_times"]` are their times, padded with infinity. As any
    event, it is found where the condition has different signs at the two ends of a step: two crossings in one step are
    none. A condition that is 0 at the start, or will be within 3e-11 of the larger of |t0| and |t1|, is on the side that it moves
    to, from rest too; where it stays at 0 for a while, that is only known where a `direction` is given, and without one the solve
    fails with `RESULTS.undetermined_side`. What a reset has brought to rest and is pulled through zero again is reset again: it fails
    with `RESULTS.too_many_jumps`. Of a time to save at that is that of a reset but for round-off, the state is that before or
    after it.

    A reset may change in `args` which equations hold. Where it changes their index, as an ideal diode that closes or opens does beside
    a coil, `RadauIIA5` and `BDF` go on, and solvers by way of the underlying ODE stop there: for these write a small and a large
    resistance in place of the ideal switch. Where it is higher by two or more than the structure has it, derivatives after it are an
    error.
    """

    condition: Callable[..., Any]
    reset: Callable[..., tuple[Any, Any]]
    direction: bool | None = eqx.field(static=True, default=None)
    fixed: Any = None
    max_resets: int = eqx.field(static=True, default=100)

    def __check_init__(self) -> None:
        for name in ("condition", "reset"):
            if not callable(getattr(self, name)):
                raise TypeError(f"`{name}` of Reset must be a function, but is {brief(getattr(self, name))}.")
        if self.direction not in (None, True, False):
            raise ValueError(
                "`direction` of Reset must be True for upcrossings, False for downcrossings or None for both, but is "
                f"{brief(self.direction)}."
            )
        if type(self.max_resets) is not int or self.max_resets < 1:
            raise ValueError(
                f"`max_resets` of Reset must be an integer of at least 1, but is {brief(self.max_resets)}."
            )


def Jump(
    condition: Callable[..., Any],
    jump: Callable[..., tuple[Any, Any]],
    direction: bool | None = None,
    fixed: State = None,
    most: int = 100,
) -> Reset:
    """The former name of `Reset`."""
    warnings.warn("`Jump(..., most=...)` is called `Reset(..., max_resets=...)` now.", DeprecationWarning, stacklevel=2)
    return Reset(condition, jump, direction, fixed, most)


class _Progress(NamedTuple):
    """Where a solve stands: the start of the next part, what was saved so far, `changed` of the args beside, and how the last part
    ended; `side` is the sign that the condition had in the last part, `changed_y` whether the last reset changed the state, `found` the
    condition there, `moved` by how much making the state there consistent changes it.
    """

    t: Float[Array, ""]
    y: Any
    args: Any
    count: Int[Array, ""]
    times: Float[Array, " jumps"]
    ts: Float[Array, " times"]
    ys: Any
    changed: list[Array]
    stats: Any
    code: Int[Array, ""]
    side: Float[Array, ""]
    changed_y: Float[Array, ""]
    found: Float[Array, ""]
    moved: Float[Array, ""]


def solve_with_resets(solve: "Solve", problem: Problem) -> tuple[DAESolution, Start]:
    """What `solve` gives, part by part; `solve.event` is a `Reset`."""

    def parts(solve: "Solve") -> tuple[Callable[[Arrays], Split], Arrays]:
        program, arrays = split((solve, problem))
        return lambda arrays: Split.of(_part_by_part(*program.whole(arrays))), arrays

    forward, _ = parts(solve.forwards())
    numbers, arrays = parts(solve)
    checked = solve.throw and solve.derivative() != "any"
    arrays = refused_if_unknown(arrays, given=True) if checked else arrays
    sol, start = one_kernel(numbers, solve.derivative(), None, forward)(arrays).whole()
    if checked:
        sol = dataclasses.replace(sol, ys=refused_if_unknown(sol.ys, given=False), given=sol.given)
    return sol, start


def _part_by_part(solve: "Solve", problem: Problem) -> tuple[DAESolution, Start]:
    system, t0, y0, args = problem.start
    t1, rank = problem.t1, problem.rank
    reset, (output,) = solve.event, saved_parts(solve.saveat)
    assert isinstance(reset, Reset)
    empty = jnp.zeros(0, t0.dtype)
    wanted = jnp.concatenate(
        [t0[None] if output.t0 else empty, empty if output.ts is None else output.ts, t1[None] if output.t1 else empty]
    )
    sign = jnp.where(t1 < t0, -1, 1).astype(t0.dtype)
    changes = _changes(reset, t0, y0, args)
    # Other numbers in the equations may leave out what the structure has in them.
    changes_args = any(jax.tree.leaves(changes))
    raised = changes_args and not is_mechanism(system) and may_be_raised(system, t0, y0, args)
    numbers, others = eqx.partition(args, _is_number)
    # In which the order of resets is round-off.
    together = 16 * float(jnp.finfo(t0.dtype).eps) ** 0.75 * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    tolerances = [of_state(solve.controller, name, y0) for name in ("rtol", "atol")]
    unknown = jnp.zeros_like(t0)
    going = int(RESULTS.event_occurred._value)

    def part(p: _Progress) -> tuple[DAESolution, Any]:
        args = eqx.combine(p.args, others)
        level, off, near = level_at_start(
            system, reset.condition, sign, p.t, p.y, args, p.side, p.changed_y, rank, together, p.found, p.moved,
            *tolerances,
        )  # fmt: skip
        near = jnp.minimum(near, SAME * jnp.abs(t1 - t0))
        # A downcrossing, as bisection has to know which way it goes.
        side = jnp.asarray({True: -1, False: 1, None: jnp.sign(level)}[reset.direction], t0.dtype)
        event = diffrax.Event(
            FromStart(reset.condition, side, p.t, level, off, near),
            Bracket(0.0, 0.0, flip=True),
            direction=False,
        )
        # No maximum, whose derivative is shared out between equal numbers.
        later = jnp.where(sign * wanted < sign * p.t, p.t, wanted)
        both = dataclasses.replace(output, t0=False, t1=True, ts=later, fn=_WithState(output.fn))
        one = dataclasses.replace(solve, event=event, saveat=diffrax.SaveAt(subs=both), raises_index=raised)
        sol, _ = one(dataclasses.replace(problem, t0=p.t, y0=p.y, args=args))
        return dataclasses.replace(sol, given=None), side

    def advance(p: _Progress) -> _Progress:
        sol, side = part(p)
        saved, states = sol.ys
        # That of the end comes after those of the times that were reached.
        row = last_saved(sol.ts)
        end, reached = sol.ts[row], jax.tree.map(lambda y: y[row], states)
        here = (sign * wanted >= sign * p.t) & (sign * wanted <= sign * end)
        ts = jnp.where(here, wanted, p.ts)
        choose = lambda a, b: jnp.where(here.reshape(-1, *(1,) * (b.ndim - 1)), a, b)
        ys = jax.tree.map(lambda new, old: choose(new[:-1], old), saved, p.ys)
        changed = list(map(choose, jax.tree.leaves(eqx.filter(p.args, changes)), p.changed))
        stats = {k: p.stats[k] + v for k, v in sol.stats.items() if k not in NO_COUNTS}
        stats["doubts"] = p.stats["doubts"] | sol.stats["doubts"]
        code = sol.result._value
        piled = (p.count > 0) & (sign * (end - p.t) <= together)
        jumps, exhausted = code == going, piled | (p.count >= reset.max_resets)
        y, after, *of_reset = lax.cond(
            jumps & ~exhausted,
            lambda: _after(system, reset, end, reached, eqx.combine(p.args, others), raised),
            lambda: (jax.tree.map(jnp.asarray, reached), p.args, unknown, unknown, unknown),
        )
        lost = jumps & ~exhausted & ~jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))
        y = jax.tree.map(lambda x, before: jnp.where(lost, before, x), y, reached)
        times = jnp.where((jnp.arange(reset.max_resets) == p.count) & jumps & ~exhausted, end, p.times)
        code = jnp.where(jumps & exhausted, RESULTS.too_many_jumps._value, code)
        code = jnp.where(lost, RESULTS.inconsistent_reset._value, code)
        if reset.direction is None:
            unseen = (side == 0) & _differs(reset.condition, end, reached, eqx.combine(p.args, others), *tolerances)
            code = jnp.where(unseen & (code == RESULTS.successful._value), RESULTS.undetermined_side._value, code)
        return _Progress(
            end, y, after, p.count + (jumps & ~exhausted), times, ts, ys, changed, stats, code, side, *of_reset
        )

    none: Any = None
    shape = jax.eval_shape(
        part, _Progress(t0, y0, numbers, none, none, none, none, none, none, none, unknown, unknown, unknown, unknown)
    )[0]
    unsaved = jax.tree.map(lambda x: jnp.full((x.shape[0] - 1, *x.shape[1:]), jnp.inf, x.dtype), shape.ys[0])
    stats = {k: jnp.zeros((), int) for k in shape.stats if k not in NO_COUNTS}
    over_times = lambda x: jnp.broadcast_to(x, (*wanted.shape, *jnp.shape(x)))
    given = list(map(over_times, jax.tree.leaves(eqx.filter(numbers, changes))))
    start = _Progress(
        t0, y0, numbers, jnp.zeros((), int), jnp.full(reset.max_resets, jnp.inf, t0.dtype),
        jnp.full_like(wanted, jnp.inf), unsaved, given, stats, jnp.asarray(going, RESULTS.successful._value.dtype), unknown,
        unknown, unknown, unknown,
    )  # fmt: skip
    kind: Any = "checkpointed" if solve.derivative() == "reverse" else "lax"
    max_steps = reset.max_resets + 1 if kind == "checkpointed" else None
    p = while_loop(lambda p: p.code == going, advance, start, kind=kind, max_steps=max_steps)
    stats = {"max_steps": solve.max_steps, **p.stats, "end_time": p.t, "jumps": p.count, "jump_times": p.times}
    result = eqx.tree_at(lambda r: r._value, RESULTS.successful, p.code)
    precision = precision_of(t0.dtype, solve.controller)
    along = jax.tree.unflatten(jax.tree.structure(eqx.filter(numbers, changes)), p.changed)
    sol = DAESolution(
        t0, t1, p.ts, p.ys, None, stats, result, None, args, count_of(rank), precision,
        changed=along, end=lax.stop_gradient((p.t, p.y)),
    )  # fmt: skip
    refused = (
        RESULTS.inconsistent_start,
        RESULTS.dependent_constraints,
        RESULTS.irregular_mass,
        RESULTS.ambiguous_start,
    )
    fine = ~jnp.any(jnp.stack([p.code == code._value for code in refused]))
    return sol, Start(jnp.where(fine, 0, 1), fine)


class _WithState(eqx.Module):
    """What is saved of a state, and that."""

    fn: Callable[..., Any]

    def __call__(self, t: Time, y: State, args: Args) -> Any:
        return self.fn(t, y, args), y


def _differs(condition: Callable[..., Any], t: Time, y: State, args: Args, rtol: State, atol: State) -> BoolScalar:
    """Whether the condition is not zero, by more than the state may be off."""
    t = jnp.asarray(t)
    return jnp.abs(condition(t, y, args)) > error_of(condition, t, y, args, rtol, atol)


def _is_number(x: object) -> bool:
    return isinstance(x, NUMBERS)


def _changes(reset: Reset, t: Time, y: State, args: Args) -> PyTree[bool]:
    """Which leaves of `args` are not handed on as they are."""
    found: list[PyTree[bool]] = []

    def look(t: Time, y: State, args: Args) -> None:
        _, new = reset.reset(t, y, args)
        found.append(jax.tree.map(lambda x, before: x is not before, new, args))

    eqx.filter_eval_shape(look, t, y, args)
    return found[0]


def _after(
    system: System, reset: Reset, t: Time, y: State, args: Args, raised: bool
) -> tuple[Any, Any, Scalar, Scalar, Scalar]:
    """The state and the numbers in the args after a reset; whether the state is another; the condition before it, which is zero but for
    the resolution of time, and by how much it is off with the state that was found: by so much it moves as that is made consistent. (As
    the state after it is, the condition may come to move by more: a rod that is longer from here on has left the stop.)
    """
    wanted, new = reset.reset(t, y, args)
    consistent = consistent_after(system, t, wanted, new, reset.fixed, raised)
    of = lambda y, args: jnp.asarray(reset.condition(t, y, args), jnp.result_type(t))
    numbers = (eqx.filter(a, _is_number) for a in (new, args))
    after = jax.tree.map(lambda x, like: jnp.asarray(x, jnp.result_type(like)), *numbers)
    before = of(y, args)
    moved = of(consistent_after(system, t, y, args, None, raised), args) - before
    found, moved = lax.stop_gradient((jnp.abs(before), jnp.abs(moved)))
    other = jnp.any(jnp.stack([jnp.any(a != b) for a, b in zip(*map(jax.tree.leaves, (wanted, y)), strict=True)]))
    return consistent, after, other.astype(found.dtype), found, moved
