"""`daesolve`: one solve of a DAE, through `diffrax.diffeqsolve`."""

import dataclasses
import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .compiler import at_ease, evaluated_now
from .compiler.types import Arrays
from .consistent import Violation
from .driver.doubts import warn
from .driver.ends import Start
from .driver.event_functions import refuse_other_outputs
from .driver.failures import OKAY, below_roundoff, in_words, not_finite_beyond, raised_in_the_program, undetermined
from .driver.options import (
    refuse_misfits,
    refuse_no_event,
    refuse_other_steps,
    refuse_wrong_options,
    with_known_options,
)
from .driver.problem import Problem, Program, split
from .driver.program import KEPT, Solve, run, traces
from .driver.resets import Reset
from .driver.start import as_array, checked, refuse_bad_start, refuse_bad_times
from .driver.tolerances import with_tolerances
from .equations.independent import is_crowded, rows_of
from .equations.residual_form import LARGE, Form
from .formulations import (
    AbstractFormulation,
    Differentiation,
    DummyDerivatives,
    ReducedResidual,
    Residual,
    why_not_as_written,
)
from .solution import RESULTS, DAESolution
from .solvers import AbstractResidualSolver, SelectedResiduals, SelectedStates, takes_residuals
from .systems import System, is_mechanism
from .types import Args, Controller, DType, ProgressMeter, Solver, State, Time
from .validate.captured import REMEMBERED, current, settle
from .validate.states import with_rates
from .validate.user_functions import not_finite, refuse_wrong_functions


_of_known_rank: dict[Program, Program] = {}
# Programs, by their hashes, whose constraints are fewer than their coordinates.
_with_few: set[int] = set()


@with_known_options
@at_ease
def daesolve(
    system: System,
    solver: Solver,
    t0: Time,
    t1: Time,
    dt0: Time | None,
    y0: State,
    args: Args = None,
    *,
    yd0: State = None,
    formulation: AbstractFormulation | None = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    stepsize_controller: Controller | None = None,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),  # noqa: B008
    event: diffrax.Event | Reset | None = None,
    max_steps: int | None = 4096,
    throw: bool = True,
    progress_meter: ProgressMeter = diffrax.NoProgressMeter(),  # noqa: B008
) -> DAESolution:
    """Solves a differential-algebraic equation. Mirrors `diffrax.diffeqsolve`.

    **Arguments**

    - `system`: the equations. What their functions take from around them (globals, closures, defaults, attributes, containers) is
      looked at in each call, and a change is seen, also one of an object in `args`; only containers of more than 2,000 containers or
      objects that are changed in place are not looked into, nor objects of other libraries. Hand over as `args` what changes often,
      as numbers and arrays: that compiles nothing anew.
    - `solver`: any diffrax solver, one that keeps its steps on the constraints (`OrthogonalProjection`,
      `SymmetricProjection`, `TangentSpace`, `RATTLE`), or one of 0 = F(t, y, ẏ) (`RadauIIA5`, `Radau`, `BDF`).
    - `t0`, `t1`, `dt0`: start, end and first (or fixed) step; t1 < t0 integrates backwards, with dt0 < 0. Where t1 = t0 the
      derivatives by them are 0.
    - `y0`: the state at `t0`: (q, v), (x, z) or y, as the system has it; must satisfy the equations, also the hidden ones. The
      derivative by it has a meaning along these; across them, where no solution starts, it is another for each method.
    - `args`: handed to the system's functions.
    - `yd0`: ẏ at the start, or near it, in the structure of `y0`: for an `ImplicitDAE` that is nonlinear in ẏ. With more than 256
      unknowns ẏ is looked for from there only, and that several ẏ satisfy the equations is not seen.
    - `formulation`: which equations are integrated; by default `Differentiation()`, the underlying ODE; for solvers of
      0 = F(t, y, ẏ) such as `RadauIIA5`, `Residual()`, or `DummyDerivatives()` where these need not converge for the
      equations as they are written (an index that is too high, or a null space of ∂F/∂ẏ that changes).
    - `stepsize_controller`: by default fixed steps if `dt0` is given, else `PIDController(rtol=1e-8, atol=1e-8)` (1e-5 in
      float32). Where unknowns have units of their own, `rtol` and `atol` may be in the structure of `y0`, with numbers or arrays in
      place of its arrays, such as `atol=(1e-9, 1e-6)` for (q, v); then units are of no account, that of time neither. A multiplier
      has the tolerance of the velocities along its constraint, a derivative ẏ, ÿ, … that is integrated that of y; what is absolute of
      both, in a mechanism, over the time τ in which the velocities' tolerance makes the positions', atol(q) / atol(v), ẍ over τ².
    - `saveat`, `adjoint`, `event`, `max_steps`, `throw`, `progress_meter`: as in diffrax. Functions in `saveat` and `event` get the state
      in the structure of `y0`, and the user's `args`. Of a time in `jump_ts` the state after the jump is saved, in the direction of the
      solve; dense output has both (`sol.evaluate(t, left=False)`). A `diffrax.Event` ends the solve where its condition is zero if it has
      a root finder, `diffrax.Event(condition, optimistix.Bisection(1e-9, 1e-9, flip="detect"))`, else at the end of the step in which
      that changes its sign. With a `Reset` as `event` the solve goes on after it. Derivatives are those of the numerical solution: where
      steps leap over a kink of a function (`abs`, `where`, `sort`) they are right to about the square root of the tolerance; make its
      time known (`jump_ts`), or a `Reset` of it. Where it jumps at a time that depends on what is differentiated, they have that
      dependence where that time is given in `jump_ts` as it depends on it (`jump_ts=jnp.stack([args.switch])`), or is that of a `Reset`;
      else they lack it, as the derivative of `where` does, and an `AccuracyWarning` says so where the time is compared with what depends
      on that. Steps of a derivative are its own, with an error of up to ten tolerances relative to its largest entry, of changes of the
      start and of a hundredth of all parameters together: about an equilibrium the solution itself allows any step. `max_steps` holds for
      them too, beyond which it is an error to ask for the derivative (with `throw=False` it is NaN), after solvers of residuals have
      tried steps for changes of the start alone. They are those of the solution, and may leap over what the derivative needs (give
      `dtmax` of the controller), with `adjoint=DirectAdjoint()`, without one kernel, with `SaveAt(dense=True)` or `steps=True`, with
      `max_steps=None` or many unknowns, and through a `custom_vjp`. Second derivatives are there in any order of modes, third ones with
      `jax.jacfwd` outside; with a progress meter or without one kernel forward-mode derivatives need `adjoint=diffrax.ForwardMode()`.

    **Returns** a `DAESolution`.

    Errors: `ValueError` or `TypeError` in a sentence for wrong input that is concrete; `RuntimeError` where the solve
    fails, or a `RESULTS` code with `throw=False`: then what is saved at times that it did not reach is infinite, also that at t1, and its
    derivatives are NaN; `sol.end` is where it stopped. An `AccuracyWarning` where it does not fail, but the answer is doubtful: it has
    drifted off the constraints by more than a thousand tolerances, fixed steps are too large for the motion, a million steps may
    add up their errors, it has passed a configuration in which the constraints depend on each other (seen with up to 32 of
    them) or a mass is negative, or the equations switch with time more than once in a step, where a pulse may be stepped over; in a
    batch or under `jit` `stats["doubts"]` says so, by bits 1, 2, 4, 8 and 16.
    """
    solve, problem = prepared(
        with_rates(system, yd0, y0), solver, t0, t1, dt0, y0, args, formulation, saveat, stepsize_controller, adjoint, event,
        max_steps, progress_meter, throw,
    )  # fmt: skip
    refuse_bad_times(solve.saveat, problem.t0, problem.t1)
    program, arrays = split((solve, problem))
    before = traces()
    if any(isinstance(x, Tracer) for x in arrays):
        sol, start, _ = run(program, arrays)
    else:
        sol, start = _run_on_numbers(program, arrays, solve, problem)
    if traces() != before:
        settle(program.leaves)
    sol = _raise_if_failed(sol, solve, problem, start.off) if throw else sol
    if not isinstance(sol.stats["doubts"], Tracer):
        # Beyond what this function is wrapped in.
        warn(sol, stacklevel=4)
    return sol


def prepared(
    system: System,
    solver: Solver,
    t0: Time,
    t1: Time,
    dt0: Time | None,
    y0: State,
    args: Args,
    formulation: AbstractFormulation | None,
    saveat: diffrax.SaveAt,
    stepsize_controller: Controller | None,
    adjoint: diffrax.AbstractAdjoint,
    event: diffrax.Event | Reset | None,
    max_steps: int | None,
    progress_meter: ProgressMeter,
    throw: bool = False,
) -> tuple[Solve, Problem]:
    """The method and the problem of a solve, checked, with the defaults filled in."""
    y0, args = checked(system, t0, t1, dt0, y0, args)
    system, args, formulation, saveat, event = current((system, args, formulation, saveat, event))
    refuse_wrong_options(saveat, stepsize_controller, adjoint, event, max_steps, progress_meter)
    if formulation is None and takes_residuals(solver):
        formulation = _for_residuals(system, t0, y0, args, solver)
    elif formulation is None:
        formulation = _UNDERLYING_ODE
    refuse_misfits(formulation, solver)
    refuse_other_steps(solver, stepsize_controller, dt0)
    if isinstance(formulation, Residual) and formulation.variable_index is None and takes_residuals(solver):
        why_not = _why_not_as_written(system, t0, y0, args, formulation, solver.highest_index)
        if why_not:
            raise ValueError(
                f"{type(solver).__name__} is not for these equations as they are written: {why_not}. Use "
                "`formulation=dae_jax.DummyDerivatives()` (or none), or a solver of the underlying ODE such as "
                "OrthogonalProjection(DOP853())."
            )
    if formulation.selects_states and takes_residuals(solver):
        formulation = ReducedResidual()
        solver = SelectedResiduals(solver.rtol, solver.atol, linear_solver=solver.linear_solver, solver=solver)
    elif formulation.selects_states:
        solver = SelectedStates(solver)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    controller: Any = with_tolerances(stepsize_controller or _default_controller(dt0, dtype), y0)
    controller = jax.tree.map(lambda x: as_array(x, dtype) if _is_real(x) else x, controller)
    start, end, step = as_array(t0, dtype), as_array(t1, dtype), None if dt0 is None else as_array(dt0, dtype)
    saveat = jax.tree.map(lambda x: as_array(x, dtype) if isinstance(x, np.ndarray | jax.Array) else x, saveat)
    if event is not None:
        refuse_no_event(solver)
    if isinstance(event, Reset):
        refuse_other_outputs(saveat)
    solve = Solve(formulation, solver, saveat, controller, adjoint, event, progress_meter, max_steps, throw)
    return solve, Problem(system, start, end, step, y0, args, getattr(system, "rank", None))


def _for_residuals(
    system: System, t0: Time, y0: State, args: Args, solver: AbstractResidualSolver
) -> AbstractFormulation:
    """The equations as they are written where the solver controls all their variables."""
    if is_mechanism(system):
        return Residual()
    size = sum(jnp.size(x) for x in jax.tree.leaves(y0))
    # Dummy derivatives, which serve beyond the default, are not for many unknowns.
    highest = solver.highest_index if size > LARGE else solver.default_index
    reason = _why_not_as_written(system, t0, y0, args, Residual(), highest)
    return DummyDerivatives() if reason else Residual()


def _why_not_as_written(system: System, t0: Time, y0: State, args: Args, formulation: Residual, highest: int) -> str:
    program, arrays = split((system, t0, y0, args))
    shapes = tuple(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in arrays)
    return _found_of_structure(program, shapes, formulation.form, highest)


@functools.lru_cache(maxsize=256)
def _found_of_structure(program: Program, shapes: tuple[jax.ShapeDtypeStruct, ...], form: Form, highest: int) -> str:
    found = []

    def look(arrays: Arrays) -> None:
        system, t0, y0, args = program.whole(arrays)
        refuse_wrong_functions(system, t0, y0, args)
        found.append(why_not_as_written(system, t0, y0, args, form, highest))

    jax.eval_shape(look, list(shapes))
    return found[0]


def _run_on_numbers(program: Program, arrays: Arrays, solve: Solve, problem: Problem) -> tuple[DAESolution, Start]:
    """`run`, refusing an inconsistent start in words. How many constraints are independent is found, and remembered, where it
    is not all of them.
    """
    known = _of_known_rank.get(program)
    if known is None:
        known = _with_rank(program, solve, problem) if _asks_for_rank(program, solve, problem) else program
    sol, start, seconds = run(known, arrays)
    # Inside an outer `jit` the result is no number, although the inputs are: they are looked at each time it is traced.
    inside = isinstance(start.surely, Tracer)
    if inside or not start.surely:
        better = _with_rank(program, solve, problem)
        if better != known:
            sol, start, more = run(better, arrays)
            seconds += more
    if not inside:
        sol.stats["compile_seconds"] = seconds
    return sol, start


def _with_rank(program: Program, solve: Solve, problem: Problem) -> Program:
    """The program for the number of constraints that are independent at the start; it is remembered."""
    with evaluated_now():
        better, _ = split((solve, of_known_rank(solve, problem)))
    _of_known_rank[program] = better
    for oldest in list(_of_known_rank)[:-KEPT]:
        _of_known_rank.pop(oldest, None)
    return better


def of_known_rank(solve: Solve, problem: Problem) -> Problem:
    """The problem with the number of constraints that are independent at the start, which is refused where it is inconsistent."""
    rank = refuse_bad_start(*problem.start, solve.formulation.inverts_mass)
    rows = rows_of(*problem.start, rank) if rank is not None and solve.needs_independent() else None
    return dataclasses.replace(problem, rank=rank, rows=rows)


def _asks_for_rank(program: Program, solve: Solve, problem: Problem) -> bool:
    """Whether to look at a start before anything is compiled: where constraints are as many as coordinates, some are redundant or
    nothing moves.
    """
    if solve.formulation.counts_constraints or (solve.needs_independent() and problem.rank is not None):
        return True
    if not is_mechanism(problem.system) or hash(program) in _with_few:
        return False
    solve.refuse_wrong_functions(problem)
    with evaluated_now():
        crowded = is_crowded(*problem.start)
    if not crowded:
        if len(_with_few) >= REMEMBERED:
            _with_few.clear()
        _with_few.add(hash(program))
    return crowded


def _is_real(x: object) -> bool:
    return isinstance(x, np.ndarray | np.generic | jax.Array) and bool(jnp.issubdtype(x.dtype, jnp.floating))


def _default_controller(dt0: Time | None, dtype: DType) -> diffrax.AbstractStepSizeController:
    if dt0 is not None:
        return diffrax.ConstantStepSize()
    return _PID64 if dtype == jnp.float64 else _PID32


_UNDERLYING_ODE = Differentiation()
_PID64, _PID32 = (diffrax.PIDController(rtol=tolerance, atol=tolerance) for tolerance in (1e-8, 1e-5))


def _raise_if_failed(sol: DAESolution, solve: Solve, problem: Problem, off: Violation | None) -> DAESolution:
    if isinstance(sol.result._value, Tracer):
        return raised_in_the_program(sol, problem, off)
    if int(sol.result._value) in OKAY:
        return sol
    beyond = not_finite_beyond(sol, problem)
    sol = dataclasses.replace(sol, result=RESULTS.not_finite) if beyond else sol
    unmet = below_roundoff(sol, solve.controller)
    said = [str(in_words(sol, problem)), not_finite(*problem.start) or beyond or unmet, undetermined(sol, problem)]
    raise RuntimeError(" ".join(filter(None, said)))
