"""`daesolve`: one solve of a DAE, through `diffrax.diffeqsolve`."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from .checks import (
    as_array,
    checked,
    refuse_bad_start,
    refuse_bad_times,
    refuse_misfits,
    refuse_no_event,
    takes_residuals,
)
from .formulations import AbstractFormulation, Differentiation, DummyDerivatives, ReducedResidual, Residual
from .jumps import Jump, refuse_other_outputs
from .program import Program, Solve, run, split
from .solution import RESULTS, DAESolution
from .solvers import SelectedResiduals, SelectedStates
from .systems import System


_ranks: dict[Program, int | None] = {}


def daesolve(
    system: System,
    solver: diffrax.AbstractSolver,
    t0: Any,
    t1: Any,
    dt0: Any,
    y0: Any,
    args: Any = None,
    *,
    formulation: AbstractFormulation | None = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),  # noqa: B008
    event: diffrax.Event | Jump | None = None,
    max_steps: int | None = 4096,
    throw: bool = True,
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),  # noqa: B008
) -> DAESolution:
    """Solves a differential-algebraic equation. Mirrors `diffrax.diffeqsolve`.

    **Arguments**

    - `system`: the equations.
    - `solver`: any diffrax solver, or one that keeps its steps on the constraints (`OrthogonalProjection`,
      `SymmetricProjection`, `TangentSpace`, `RATTLE`).
    - `t0`, `t1`, `dt0`: start, end and first (or fixed) step; t1 < t0 integrates backwards, with dt0 < 0.
    - `y0`: the state at `t0`: (q, v), (x, z) or y, as the system has it; must satisfy the equations, also the hidden ones.
    - `args`: handed to the system's functions.
    - `formulation`: which equations are integrated; by default `Differentiation()`, the underlying ODE, and `Residual()`
      for solvers of 0 = F(t, y, ẏ) such as `RadauIIA5`.
    - `stepsize_controller`: by default fixed steps if `dt0` is given, else `PIDController(rtol=1e-8, atol=1e-8)` (1e-5 in
      float32).
    - `saveat`, `adjoint`, `event`, `max_steps`, `throw`, `progress_meter`: as in diffrax. Functions in `saveat` and
      `event` get the state in the structure of `y0`, and the user's `args`. With a `Jump` as `event` the solve goes on
      after it. Forward-mode derivatives need `adjoint=diffrax.ForwardMode()`.

    **Returns** a `DAESolution`.

    Errors: `ValueError` or `TypeError` in a sentence for wrong input that is concrete; `RuntimeError` where the solve
    fails, or a `RESULTS` code with `throw=False`.
    """
    inputs = prepared(
        system, solver, t0, t1, dt0, y0, args, formulation, saveat, stepsize_controller, adjoint, event, max_steps,
        progress_meter,
    )  # fmt: skip
    program, arrays = split(inputs)
    if any(isinstance(x, jax.core.Tracer) for x in arrays):
        sol, *_ = run(program, getattr(system, "rank", None), arrays)
    else:
        sol = _run_on_numbers(program, arrays, inputs)
    return _raise_if_failed(sol) if throw else sol


def prepared(
    system: Any, solver: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, formulation: Any, saveat: Any,
    stepsize_controller: Any, adjoint: Any, event: Any, max_steps: Any, progress_meter: Any,
) -> tuple[Solve, Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """The method and (system, t0, t1, dt0, y0, args) of a solve, checked, with the defaults filled in."""
    y0, args = checked(system, t0, t1, dt0, y0, args)
    if formulation is None:
        formulation = Residual() if takes_residuals(solver) else Differentiation()
    refuse_misfits(system, formulation, solver, t0, y0, args)
    if isinstance(formulation, DummyDerivatives) and takes_residuals(solver):
        formulation, solver = ReducedResidual(), SelectedResiduals(solver.rtol, solver.atol, solver=solver)
    elif isinstance(formulation, DummyDerivatives):
        solver = SelectedStates(solver)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    if stepsize_controller is None:
        stepsize_controller = _default_controller(solver, dt0, dtype)
    t0, t1, dt0 = (x if x is None else as_array(x, dtype) for x in (t0, t1, dt0))
    saveat = jax.tree.map(lambda x: as_array(x, dtype) if isinstance(x, np.ndarray | jax.Array) else x, saveat)
    if event is not None:
        refuse_no_event(solver)
    if isinstance(event, Jump):
        refuse_other_outputs(saveat)
    solve = Solve(formulation, solver, saveat, stepsize_controller, adjoint, event, max_steps, progress_meter)
    return solve, system, t0, t1, dt0, y0, args


def _run_on_numbers(program: Program, arrays: list[Any], inputs: Any) -> DAESolution:
    """`run`, refusing an inconsistent start in words. How many constraints are independent is found, and remembered, where it
    is not all of them.
    """
    solve, system, t0, t1, _, y0, args = inputs
    refuse_bad_times(solve.saveat, t0, t1)
    sol, as_expected, seconds = run(program, _ranks.get(program, getattr(system, "rank", None)), arrays)
    # Inside an outer `jit` the result is no number, although the inputs are: they are looked at each time it is traced.
    inside = isinstance(as_expected, jax.core.Tracer)
    if inside or not as_expected:
        with jax.ensure_compile_time_eval():
            _ranks[program] = refuse_bad_start(system, t0, y0, args)
        sol, _, more = run(program, _ranks[program], arrays)
        seconds += more
    if not inside:
        sol.stats["compile_seconds"] = seconds
    return sol


def _default_controller(solver: Any, dt0: Any, dtype: Any) -> Any:
    if dt0 is not None:
        return diffrax.ConstantStepSize()
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(f"`dt0` must be given: {type(solver).__name__} takes fixed steps.")
    return _PID64 if dtype == jnp.float64 else _PID32


_PID64, _PID32 = (diffrax.PIDController(rtol=tolerance, atol=tolerance) for tolerance in (1e-8, 1e-5))


_OKAY = {int(code._value) for code in (RESULTS.successful, RESULTS.event_occurred)}


def _raise_if_failed(sol: DAESolution) -> DAESolution:
    if isinstance(sol.result._value, jax.core.Tracer):
        okay = (sol.result == RESULTS.successful) | (sol.result == RESULTS.event_occurred)
        return sol.result.error_if(sol, ~okay)
    if int(sol.result._value) in _OKAY:
        return sol
    reached = [np.asarray(t)[np.isfinite(t)] for t in jax.tree.leaves(sol.ts)]
    last = [t[-1] for t in reached if t.size]
    where = f" (last saved time: t = {last[-1]:.6g})" if last else ""
    raise RuntimeError(f"{RESULTS[sol.result]}{where} {sol.stats['num_steps']} steps were taken.")
