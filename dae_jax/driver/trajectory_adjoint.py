"""The reverse derivative of a solve from the trajectory of its accepted steps.

The derivative is that of the discrete solution (discretise-then-optimise), as with `diffrax.RecursiveCheckpointAdjoint`;
the sizes of the steps are constants, but for the last, which ends at t1, and for fixed ones. Forwards, the point of every
accepted step is written down; backwards, each step is done once more together with its derivative. Both are loops of plain
arithmetic, which compile to a kernel each; diffrax's checkpoints need library calls. It is used where the trajectory is small, and
for solvers whose step is a function of its start, or that can `replay` it: of implicit ones the trajectory has the stages, and a
step costs its derivative alone.
"""

from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._compat import WrapTerm
from ..equations.residual_form import LARGE
from ..solvers import is_recomputable, replays
from ..types import IntScalar, Scalar, Time, Y
from .between_steps import has_flow
from .crossings import OnStates
from .event_adjoint import at_event
from .followed_steps import Stop
from .no_length import row_times
from .start import is_saved_part


if TYPE_CHECKING:
    from .program import Solve
    from .step_inputs import StepInputs


# Numbers of a trajectory, at most, of points, and of a large system, whose steps take longer than to lay out the trajectory, in all; beyond
# that diffrax's checkpoints, which take twice the time and more.
LARGEST_TRAJECTORY, LARGEST_OF_LARGE = 2**20, 2**25


def has_trajectory_adjoint(solve: "Solve", size: int) -> bool:
    """Whether it serves a solve with `size` unknowns."""
    saveat, part = solve.saveat, solve.saveat.subs
    numbers, largest = (solve.max_steps or 0) + 1, LARGEST_TRAJECTORY
    if size > LARGE:
        numbers, largest = numbers * (1 + getattr(solve.solver, "kept", 0)), LARGEST_OF_LARGE
    # The end of a solve with events moves as the equations say, of which a form has up to eight times as many unknowns.
    end_has_flow = has_flow(solve.formulation, jax.ShapeDtypeStruct((8 * size,), float))
    return (
        is_saved_part(part)
        and not (part.steps or saveat.dense or saveat.solver_state or saveat.controller_state or saveat.made_jump)
        and (solve.event is None or (solve.has_steps_of_derivatives(size) and end_has_flow))
        and type(solve.controller) in (diffrax.PIDController, diffrax.ConstantStepSize)
        and solve.max_steps is not None
        and numbers * size <= largest
        and (is_recomputable(solve.solver) or replays(solve.solver))
    )


def recorded(stages: bool) -> diffrax.SaveAt:
    """Every accepted step, and its `stages`, in place of what is asked for, of which nothing is needed once more."""
    return diffrax.SaveAt(subs=diffrax.SubSaveAt(t0=True, steps=True, fn=as_it_is), dense=stages)


# What a trajectory holds: the point in the integration's variables.
as_it_is = lambda t, y, ode: y


def cotangents(
    numbers: "StepInputs",
    rest: "StepInputs",
    fixed_steps: bool,
    trajectory: tuple[Float[Array, " steps"], Y, PyTree[Array]],
    wanted: tuple[Float[Array, " times"], PyTree[Array]],
    of_end: Scalar,
    stop: Stop | None,
) -> "StepInputs":
    """The cotangents of what moves.

    **Arguments**

    - `numbers`, `rest`: what `StepInputs.moving_apart` gives.
    - `fixed_steps`: whether the first step is dt0 and the others end where they divide the interval evenly; otherwise all have
      sizes of their own but the last.
    - `trajectory`: times and points of the accepted steps, the start first, and for a solver that replays them what is between;
      times that are not finite are padding.
    - `wanted`: the cotangents of the saved times and values, a leading axis of times; `of_end`: that of the time at the end.
    - `stop`: where the solution ended, and by which event, where it has events: the end is t1 here, which follows from all else.
    """
    times, points, between = trajectory
    of_saved_times, wanted = wanted
    inputs = eqx.combine(numbers, rest)
    part = inputs.part
    save_times = jnp.zeros(0, times.dtype) if part.ts is None else part.ts
    first = int(part.t0)
    direction = jnp.where(inputs.t1 < inputs.t0, -1, 1)
    last = jnp.sum(jnp.isfinite(times)) - 1
    # What is saved of the end comes after the times that it was reached by.
    reached = save_times.size if stop is None else jnp.sum(direction * (save_times - stop.time) <= 0)
    first_saved, last_saved, end = _needed(direction, times, save_times, wanted, first, reached)
    end = jnp.minimum(end, last - 1)
    still = inputs.view.decode.still
    times_move = jax.tree.leaves((numbers.t0, numbers.t1, numbers.dt0, numbers.part.ts))
    of_ends = (lambda times: times) if times_move and not still else lax.stop_gradient
    # What is saved moves with its time as the equations say, but where an event ends it at once; and not at all where nothing is asked
    # for that.
    moves = (last > 0) | (stop is None or stop.event < 0)
    of_flow = (lambda t: jnp.where(moves, t, lax.stop_gradient(t))) if times_move else lax.stop_gradient

    def saved(numbers: PyTree, t: Time, y: Y) -> Any:
        all_of = eqx.combine(numbers, rest)
        return all_of.view(of_flow(t), y, all_of.ode)

    # Without a step the end, too, is a row of the start; it is shown by another function where steps move as they do.
    flows = has_flow(inputs.formulation, inputs.y)
    starts_apart = bool(part.t1 and times_move) and flows and not still

    def saved_of_start(numbers: PyTree, t: Time) -> Any:
        all_of = eqx.combine(numbers, rest)
        view = all_of.view.as_still() if flows else all_of.view
        return view(of_flow(t), all_of.y, all_of.ode)

    def values(numbers: PyTree, t: Time, y: Y) -> list[Any]:
        all_of = eqx.combine(numbers, rest)
        conditions = jax.tree.leaves(all_of.conditions, is_leaf=lambda x: isinstance(x, OnStates))
        return [condition(direction * t, y, all_of.ode) for condition in conditions]

    def parts(numbers: PyTree) -> tuple[Any, Any, Any]:
        all_of = eqx.combine(numbers, rest)
        return WrapTerm(all_of.formulation.term(), direction), all_of.solver, all_of.ode

    def history_at_start(numbers: PyTree) -> Any:
        term, solver, ode = parts(numbers)
        if not replays(solver):
            return ()
        return solver.history_at_start(term, direction * times[0], direction * times[1], _entry(points, 0), ode)

    def step(numbers: PyTree, y: Y, history: PyTree, a: Scalar, b: Scalar, known: PyTree[Array]) -> Any:
        (term, solver, ode), (a, b) = parts(numbers), of_ends((direction * a, direction * b))
        if replays(solver):
            y1, history, dense = solver.replay(term, a, b, y, ode, history, known)
        else:
            y1, _, dense, *_ = solver.step(term, a, b, y, ode, solver.init(term, a, b, y, ode), False)
        moving, fixed = eqx.partition(dense if save_times.size else None, eqx.is_inexact_array)
        return (y1, history, moving), fixed

    def within(numbers: PyTree, moving: PyTree, fixed: PyTree, a: Scalar, b: Scalar, t: Time) -> Any:
        solver = eqx.combine(numbers, rest).solver
        a, b, at = of_ends((direction * a, direction * b, direction * t))
        return saved(numbers, t, solver.interpolation_cls(t0=a, t1=b, **eqx.combine(moving, fixed)).evaluate(at))

    def shared(k: IntScalar, cotangent: Scalar) -> tuple[Any, Any, Any]:
        """The cotangent of the k-th time as those of t0, t1 and dt0: how diffrax's controllers make it from them."""
        evenly = jnp.where(k == 1, 0.0, (times[k] - inputs.t0) / (inputs.t1 - inputs.t0)) if fixed_steps else 0.0
        fraction = jnp.where(times[k] == inputs.t1, 1.0, evenly)
        first = jnp.where((k == 1) & (times[k] != inputs.t1), 1.0, 0.0) if fixed_steps else 0.0
        return (1 - fraction) * cotangent, fraction * cotangent, first * cotangent

    def saves_in_step(k: IntScalar, moving: PyTree, fixed: PyTree, carry: tuple[PyTree, ...]) -> Any:
        a, b = times[k], times[k + 1]

        def more(carry: tuple[PyTree, ...]) -> Any:
            j = carry[0]
            return (j >= first_saved) & ((direction * (save_times[j] - a) > 0) | (k == 0))

        def pull(carry: tuple[PyTree, ...]) -> Any:
            j, of_numbers, of_dense, of_a, of_b, of_times = carry
            _, pull_back = jax.vjp(
                lambda n, moving, a, b, t: within(n, moving, fixed, a, b, t), numbers, moving, a, b, save_times[j]
            )
            more_numbers, more_dense, more_a, more_b, of_t = pull_back(_entry(wanted, first + j))
            of_times = lax.dynamic_update_index_in_dim(of_times, of_times[j] + of_t, j, 0)
            return (
                j - 1,
                _sum(of_numbers, more_numbers),
                _sum(of_dense, more_dense),
                of_a + more_a,
                of_b + more_b,
                of_times,
            )

        return lax.while_loop(more, pull, carry)

    begin, begins = jax.vjp(history_at_start, numbers)

    def one_step(carry: tuple[PyTree, ...]) -> Any:
        k, j, of_y, of_history, of_numbers, of_t0, of_t1, of_times = carry
        history = begin
        if jax.tree.leaves(begin):
            before = inputs.solver.history_after(_entry(between, jnp.maximum(k - 1, 0)))
            history = jax.tree.map(lambda x, y: jnp.where(k == 0, x, y), begin, before)
        known = _entry(between, k)
        (_, _, moving), pull_back, fixed = jax.vjp(
            lambda n, y, history, a, b: step(n, y, history, a, b, known),
            numbers,
            _entry(points, k),
            history,
            times[k],
            times[k + 1],
            has_aux=True,
        )
        of_dense, of_a, of_b = _zeros(moving), jnp.zeros_like(of_t0), jnp.zeros_like(of_t0)
        if save_times.size:
            j, of_numbers, of_dense, of_a, of_b, of_times = saves_in_step(
                k, moving, fixed, (j, of_numbers, of_dense, of_a, of_b, of_times)
            )
        more_numbers, of_y, of_history, more_a, more_b = pull_back((of_y, of_history, of_dense))
        (a0, a1, a2), (b0, b1, b2) = shared(k, of_a + more_a), shared(k + 1, of_b + more_b)
        of_numbers = _sum(of_numbers, more_numbers)
        of_numbers = of_numbers._replace(dt0=_plus(of_numbers.dt0, a2 + b2))
        return k - 1, j, of_y, of_history, of_numbers, of_t0 + a0 + b0, of_t1 + a1 + b1, of_times

    of_y, of_numbers, zero = _zeros(_entry(points, 0)), _zeros(numbers), jnp.zeros_like(inputs.t0)
    of_t1, row = of_end, first + reached
    if part.t1:
        of_last = jax.tree.map(lambda x: jnp.where(starts_apart & (last == 0), 0, x), _entry(wanted, row))
        _, pull_back = jax.vjp(saved, numbers, inputs.t1, _entry(points, last))
        of_numbers, more_t1, of_y = pull_back(of_last)
        of_t1 = of_t1 + more_t1 + of_saved_times[row]
        end = jnp.where(_is_zero(of_last), end, last - 1)
    if stop is not None:
        end = jnp.where(of_t1 == 0, end, last - 1)
        if inputs.conditions is not None:
            more_numbers, more_y = at_event(stop.event, values, numbers, inputs.t1, _entry(points, last), of_t1)
            of_numbers, of_y = _sum(of_numbers, more_numbers), _sum(of_y, more_y)
        of_t1 = jnp.where(stop.event >= 0, 0, of_t1)
    carry = (end, last_saved, of_y, _zeros(begin), of_numbers, zero, of_t1, jnp.zeros_like(save_times))
    _, _, of_y, of_begin, of_numbers, of_t0, of_t1, of_times = lax.while_loop(
        lambda carry: carry[0] >= 0, one_step, carry
    )
    of_numbers = _sum(of_numbers, begins(of_begin)[0])
    of_numbers = of_numbers._replace(y=_sum(of_numbers.y, of_y))
    if first or save_times.size or starts_apart:
        rows = row_times(part, inputs.t0, inputs.t1)
        count = jnp.where(last > 0, first, first + reached + starts_apart)

        def row_of_start(carry: tuple[PyTree, ...]) -> Any:
            k, of_numbers, of_rows = carry
            i = jnp.where(k < first + reached, k, rows.size - 1)
            _, pull_back = jax.vjp(saved_of_start, numbers, rows[i])
            more_numbers, of_t = pull_back(_entry(wanted, k))
            return k + 1, _sum(of_numbers, more_numbers), of_rows.at[i].add(of_t)

        start = jnp.asarray(0), of_numbers, jnp.zeros_like(rows)
        _, of_numbers, of_rows = lax.while_loop(lambda carry: carry[0] < count, row_of_start, start)
        of_t0 = of_t0 + (of_rows[0] + of_saved_times[0] if first else 0)
        of_t1 = of_t1 + (of_rows[-1] if starts_apart else 0)
        of_times = of_times + of_rows[first : first + save_times.size]
    counts = jnp.arange(save_times.size) < reached
    return with_times(
        of_numbers, of_t0, of_t1, of_times + jnp.where(counts, of_saved_times[first : first + save_times.size], 0)
    )


def with_times(of_inputs: "StepInputs", of_t0: Scalar, of_t1: Scalar | None, of_times: Array | None) -> "StepInputs":
    """`of_inputs` and what else its times have."""
    found = of_inputs._replace(t0=_plus(of_inputs.t0, of_t0), t1=_plus(of_inputs.t1, of_t1))
    if of_inputs.part.ts is None or of_times is None:
        return found
    return eqx.tree_at(lambda found: found.part.ts, found, of_inputs.part.ts + of_times)


def _plus(cotangent: Any, more: Any) -> Any:
    """The sum; `None` where there is no cotangent of what does not move."""
    return cotangent if cotangent is None or more is None else cotangent + more


def _needed(
    direction: IntScalar, times: Array, save_times: Array, wanted: PyTree[Array], first: int, reached: IntScalar | int
) -> tuple[IntScalar, IntScalar, IntScalar]:
    """The first and the last saved time that was reached and whose cotangent is not 0, and the step that the last is in; −1: none. What
    comes after it is left out: where a solve fails it may have no derivative.
    """
    none = jnp.asarray(-1)
    if not save_times.size:
        return none, none, none
    numbers = jnp.arange(save_times.size)
    counts = ~jax.vmap(lambda j: _is_zero(_entry(wanted, first + j)))(numbers) & (numbers < reached)
    first_saved = jnp.min(jnp.where(counts, numbers, save_times.size))
    last_saved = jnp.max(jnp.where(counts, numbers, -1))
    before = jnp.sum(jnp.isfinite(times) & (direction * (times - save_times[last_saved]) < 0)) - 1
    return first_saved, last_saved, jnp.where(last_saved < 0, -1, jnp.maximum(before, 0))


def _is_zero(tree: PyTree[Array]) -> Any:
    return jnp.all(jnp.stack([jnp.all(x == 0) for x in jax.tree.leaves(tree)]))


def _entry(tree: PyTree[Array], i: IntScalar | int) -> Any:
    return jax.tree.map(lambda x: x[i], tree)


def _zeros(tree: PyTree[Array]) -> Any:
    return jax.tree.map(jnp.zeros_like, tree)


def _sum(a: PyTree[Array], b: PyTree[Array]) -> Any:
    return jax.tree.map(jnp.add, a, b)
