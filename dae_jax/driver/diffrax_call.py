"""A solve as a call of `diffrax.diffeqsolve`, which sees the solver's state where the user sees his own."""

import dataclasses
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import lax

from .._compat import use_stepsize_tol
from ..equations.manifold_ode import Equations, ManifoldODE
from ..linalg import error_norm
from ..solution import RESULTS, Interpolation, Split
from ..solvers import (
    AbstractManifoldSolver,
    WithoutFailedSteps,
    counts,
    economical,
    first_step,
    takes_residuals,
)
from ..types import BoolScalar, Time, Y
from .between_steps import Flow, StillSteps, along_flow, beside, has_flow, held, jump_times
from .bracket import bracketing
from .crossings import OneCrossing, OnStates
from .event_adjoint import conditions_of
from .event_functions import known_to_conditions
from .felt_steps import SMALL, OneDirection, felt_steps
from .followed_formulas import KnownFormulas
from .followed_steps import RecordedEnds, Steps, at_steps, taken
from .no_length import Begin, moving_with_times
from .observed_steps import Observer, observed
from .passages import passages
from .problem import Problem
from .start import is_saved_part
from .summed_errors import SummedErrors
from .switches import stepped_over
from .tolerances import in_integrated, in_one_vector, measured
from .traced_once import TracedOnce
from .trajectory_adjoint import as_it_is, has_trajectory_adjoint


if TYPE_CHECKING:
    from .program import Solve


class Decode(eqx.Module):
    """The user's view of a point of the solver's dense output, which moves with its time where steps are `still`, and on its own where
    they are not.
    """

    flow: Flow
    solver: diffrax.AbstractSolver
    still: bool = eqx.field(static=True)
    # Times that are announced, at which functions may jump.
    jumps: Any = None

    def __call__(self, t: Time, y: Y, ode: Equations) -> Any:
        of_y = lax.stop_gradient(t) if self.still else t
        if isinstance(self.solver, AbstractManifoldSolver):
            y = self.solver.retract(of_y, y, cast(ManifoldODE, ode))
        y = along_flow(y, t, self.flow, ode) if self.still else y
        return self.flow.formulation.decode(t, y, ode)

    def between(self, path: diffrax.DenseInterpolation, t: Time, left: bool, ode: Equations) -> Any:
        """The state at any time, whose derivative by it is ẏ but in large systems of residuals; on the asked side of a jump."""
        still = has_flow(self.flow.formulation, path.y0_if_trivial)
        t = beside(jnp.asarray(t, path.ts.dtype), self.jumps, left, path)
        y = path.evaluate(lax.stop_gradient(t) if still else t, left=left)
        flow = dataclasses.replace(self.flow, later=True)
        return dataclasses.replace(self, flow=flow, still=still)(t, y, ode)


class View(eqx.Module):
    """What is saved of a point of the solver's dense output."""

    fn: Callable[..., Any]
    decode: Decode
    args: Any

    def __call__(self, t: Time, y: Y, ode: Equations) -> Any:
        return self.fn(t, self.decode(t, y, ode), self.args)

    def as_still(self) -> "View":
        """The same of a point that moves with its time as the equations say."""
        return dataclasses.replace(self, decode=dataclasses.replace(self.decode, still=True))


def call(solve: "Solve", problem: Problem, steps: Steps | None = None) -> tuple[Any, ...]:
    """`diffrax.diffeqsolve` on what the formulation makes of the problem; the fields of its solution, the end, and its steps where
    they are needed. `steps`: those to take.
    """
    t0, t1, dt0, args = problem.t0, problem.t1, problem.dt0, problem.args
    start, ode = solve.encoded(problem)
    event = cast(diffrax.Event | None, solve.event)
    flow, still, jumps = solve.flow(), solve.is_still(start), jump_times(solve.controller)
    y = held(start, t0, flow, ode) if still else start
    decode = Decode(flow, solve.solver, still, jumps if solve.saveat.dense else None)
    solver = economical(solve.solver, solve.between())
    controller = in_integrated(_fitted(solve.controller), t0, y, ode, solve.formulation)
    ode = measured(ode, controller, t0, y)
    felt = SMALL * jax.lax.stop_gradient(jnp.abs(t1 - t0)) if isinstance(solve.adjoint, OneDirection) else None
    if takes_residuals(solver):
        solver = _with_tolerances_of(controller, solver)
        # Known steps have succeeded once; rounded in another way Newton's method may take longer for one, or seem to diverge.
        # As an array: the step is not traced anew for it.
        ode = dataclasses.replace(ode, felt=felt, patient=jnp.asarray(steps is not None))
        chosen = dt0 is None and not isinstance(controller, diffrax.StepTo)
        dt0 = first_step(ode.start, solver, t0, t1, y) if chosen else dt0
    else:
        controller = in_one_vector(_with_smallest_step(controller, t0, t1), y)
        solver = _filled_in(solver, controller, solve.adjoint)

    def saved(part: diffrax.SubSaveAt) -> Any:
        return part if part.fn is as_it_is else eqx.tree_at(lambda s: s.fn, part, View(part.fn, decode, args))

    subs = {
        "user": jax.tree.map(saved, solve.saveat.subs, is_leaf=is_saved_part),
        "end": diffrax.SubSaveAt(t1=True, fn=decode),
    }
    saveat = eqx.tree_at(lambda s: s.subs, solve.saveat, subs, is_leaf=lambda x: x is None)
    if event is not None:
        direction, given = jnp.where(t1 < t0, -1, 1), known_to_conditions(solve, problem)
        conditions = conditions_of(event, decode, args, direction, given)
        event = dataclasses.replace(event, cond_fn=conditions, root_finder=bracketing(event.root_finder))
    # What is doubtful about a solution is seen in itself, not where it is done again.
    first = steps is None and not solve.recording
    observers: dict[str, Observer] = {}
    if first and _may_ignore_errors(solve.controller):
        observers["errors"] = SummedErrors()
    looped = _for_loops(solve, solver, y, *_kinds(event, t0, y, ode), t0, t1)
    records = steps is None and (felt is not None or solve.records_steps())
    if records:
        assert solve.max_steps is not None
        observers["ends"] = RecordedEnds(solve.max_steps)
    if takes_residuals(solver) and (records or steps is not None):
        looped = KnownFormulas(looped, solver, None if steps is None else steps.formulas, solve.max_steps or 0)
    known = isinstance(looped, KnownFormulas)
    looped = StillSteps(looped, flow, jumps) if still else looped
    state_is_read = known or counts(solver)
    saveat = dataclasses.replace(saveat, solver_state=True) if state_is_read else saveat
    drifts, masses = not solve.keeps()[0], solve.formulation.inverts_mass
    passage = passages(problem, ode, solve.formulation.decode, drifts, masses) if first else None
    if passage is not None:
        observers["passage"] = passage
    switches = stepped_over(problem) if first else None
    if switches is not None:
        observers["switches"] = switches
    if felt is not None and isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        controller = felt_steps(controller, felt)
    controller = observed(controller if steps is None else at_steps(controller, steps.times), observers)
    saveat = dataclasses.replace(saveat, controller_state=True) if observers else saveat
    sol = diffrax.diffeqsolve(
        solve.formulation.term(),
        looped,
        t0, t1, dt0, y,
        args=ode, saveat=saveat, stepsize_controller=controller, adjoint=solve.adjoint, event=event,
        max_steps=solve.max_steps, throw=False, progress_meter=solve.progress_meter,
    )  # fmt: skip
    path = sol.interpolation
    if path is not None and isinstance(solver, AbstractManifoldSolver):
        path = solver.whole_path(path)
    interpolation = None if path is None else Interpolation.of(path, decode, ode)
    ts, ys = cast(Any, sol.ts), cast(Any, sol.ys)
    if has_flow(solve.formulation, y) and not solve.recording:
        begin = lambda fn: Begin(t0, start, flow, View(fn, decode, args).as_still(), ode)
        is_all = (t0 == t1) & ~jnp.any(jnp.stack([jnp.asarray(False), *jax.tree.leaves(sol.event_mask)]))
        ts["user"], ys["user"] = moving_with_times(solve.saveat.subs, ts["user"], ys["user"], begin, t1, is_all)
    end = jax.lax.stop_gradient(jax.tree.map(lambda x: x[-1], (ts["end"], ys["end"])))
    # Where there is no step diffrax has the end at t0.
    stats = {**sol.stats, "end_time": jnp.where(t0 == t1, t1, ts["end"][-1])}
    starts = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))
    result = RESULTS.where(starts, RESULTS.promote(sol.result), RESULTS.no_finite_start)
    state: Any = sol.solver_state
    state, formulas = (state.inner, state.formulas) if known else (state, None)
    stats.update((path.split(".")[-1], operator.attrgetter(path)(state)) for path in counts(solver))
    found = lax.stop_gradient(cast(Any, sol.controller_state)).seen if observers else {}
    passed = False
    if "passage" in found:
        passed, determined, _ = found["passage"]
        result = RESULTS.where((result == RESULTS.successful) & ~jnp.asarray(determined), RESULTS.undetermined, result)
    seen = found["errors"].total if "errors" in found else None, passed, found.get("switches", False)
    ways = taken(found["ends"], formulas) if "ends" in found else steps if solve.saves_steps() else None
    return sol.t0, sol.t1, ts["user"], ys["user"], interpolation, stats, result, sol.event_mask, seen, end, ways


def failed(out: Split, problem: Problem) -> BoolScalar:
    """Whether what a `call` has given ended on its way, without an event."""
    *_, stats, _, event_mask, _, _, _ = out.numbers
    return ~jnp.any(jnp.stack([stats["end_time"] == problem.t1, *jax.tree.leaves(event_mask)]))


def took_steps(fields: tuple[Any, ...]) -> BoolScalar:
    """Whether all steps of a `call` to which they were given have succeeded: one that has not ends in NaN, in which a condition seems to
    cross zero, but is not found to. (A solve that failed ends on a number, that of the last step it had.)
    """
    *_, (_, state), _ = fields
    finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state)]
    return jnp.all(jnp.stack(finite)) & (fields[6] != RESULTS.nonlinear_max_steps_reached)


def steps_of(solve: "Solve", problem: Problem, failed: BoolScalar) -> tuple[Steps, BoolScalar]:
    """The steps of a `call` that records them, and whether they lead to its end, or the solution itself has `failed`."""
    *_, event_mask, _, _, steps = call(solve, problem)
    last = jnp.max(jnp.where(jnp.isfinite(steps.times), steps.times, -jnp.inf))
    at_end = last >= jnp.where(problem.t1 < problem.t0, -problem.t1, problem.t1)
    return steps, jnp.any(jnp.stack([failed, problem.t0 == problem.t1, at_end, *jax.tree.leaves(event_mask)]))


def _kinds(event: diffrax.Event | None, t: Time, y: Y, ode: Equations) -> tuple[list[OnStates], list[OnStates]]:
    """The conditions of an event that cross zero, and those that become true."""
    conditions = [] if event is None else jax.tree.leaves(event.cond_fn, is_leaf=callable)
    crosses = [jnp.issubdtype(eqx.filter_eval_shape(c, t, y, ode).dtype, jnp.floating) for c in conditions]
    chosen = lambda kind: [c for c, is_real in zip(conditions, crosses, strict=True) if is_real == kind]
    return chosen(True), chosen(False)


def _for_loops(
    solve: "Solve",
    solver: diffrax.AbstractSolver,
    y: Y,
    conditions: list[OnStates],
    flags: list[OnStates],
    t0: Time,
    t1: Time,
) -> Any:
    """The solver as diffrax's loops and its reverse derivative need it; the trajectory has accepted steps only."""
    size = sum(leaf.size for leaf in jax.tree.leaves(y))
    ours = (isinstance(solver, AbstractManifoldSolver) or takes_residuals(solver)) and not hasattr(
        solver, "root_finder"
    )
    by_diffrax = solve.derivative() == "reverse" and not has_trajectory_adjoint(solve, size)
    solver = WithoutFailedSteps(solver) if ours and by_diffrax else solver
    return TracedOnce(OneCrossing.of(solver, conditions, flags, solve.formulation, t0, t1) if conditions else solver)


def _fitted(controller: diffrax.AbstractStepSizeController) -> Any:
    """The controller with its default norm without a library call."""
    if type(controller) is diffrax.PIDController and controller.norm is optimistix.rms_norm:
        return dataclasses.replace(controller, norm=error_norm)
    return controller


def _with_smallest_step(controller: diffrax.AbstractStepSizeController, t0: Time, t1: Time) -> Any:
    """The controller with a smallest step at the resolution of time, below which a solve cannot get on; a solver of residuals
    finds by itself where that is.
    """
    if type(controller) is not diffrax.PIDController or controller.dtmin is not None:
        return controller
    floor = 16 * jnp.finfo(jnp.result_type(t0)).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    return dataclasses.replace(controller, dtmin=floor, force_dtmin=False)


def _may_ignore_errors(controller: Any) -> bool:
    """Whether steps may go on whose error is above the tolerance: fixed ones, and those that a user's `dtmin` holds up."""
    forced = getattr(controller, "dtmin", None) is not None and getattr(controller, "force_dtmin", False)
    inner = getattr(controller, "controller", None)
    return (
        isinstance(controller, diffrax.ConstantStepSize) or forced or (inner is not None and _may_ignore_errors(inner))
    )


def _filled_in(solver: Any, controller: diffrax.AbstractStepSizeController, adjoint: diffrax.AbstractAdjoint) -> Any:
    """An implicit solver of diffrax, within however many others, with what diffrax fills in for it in the outermost two only: the
    controller's tolerances where it has none, and loops that can be differentiated as the `adjoint` asks for.
    """
    inner = getattr(solver, "solver", None)
    if inner is not None:
        return dataclasses.replace(solver, solver=_filled_in(inner, controller, adjoint))
    finder: Any = getattr(solver, "root_finder", None)
    if finder is None:
        return solver
    changed: dict[str, Any] = {}
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        open_ones = [name for name in ("rtol", "atol", "norm") if getattr(finder, name, None) is use_stepsize_tol]
        changed["root_finder"] = dataclasses.replace(finder, **{name: getattr(controller, name) for name in open_ones})
    if getattr(solver, "scan_kind", "") is None:
        direct = "bounded" if isinstance(adjoint, diffrax.DirectAdjoint) else None
        changed["scan_kind"] = "lax" if isinstance(adjoint, diffrax.ForwardMode) else direct
    return dataclasses.replace(solver, **changed)


def _with_tolerances_of(controller: diffrax.AbstractStepSizeController, solver: diffrax.AbstractSolver) -> Any:
    """A solver of residuals with the controller's tolerances where it has none."""
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return solver
    rtol, atol = (getattr(solver, name) or getattr(controller, name) for name in ("rtol", "atol"))
    return dataclasses.replace(cast(Any, solver), rtol=rtol, atol=atol)
