"""How a solve ended: one code for what diffrax says, what its start and end show, and what is not finite."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from ..solution import RESULTS, DAESolution, all_finite, precision_of, went_well
from ..solvers import takes_residuals
from ..types import Scalar, State
from . import doubts
from .problem import Problem, count_of
from .reached import without_rows
from .start import is_saved_part, saved_parts


if TYPE_CHECKING:
    from .program import Solve


# How solves end at a singular configuration, of which they know nothing.
_STUCK = (
    "step_rejected", "off_manifold", "no_convergence", "error_too_large", "singular_iteration_matrix", "max_steps_reached",
)  # fmt: skip


def judged(
    solve: "Solve", out: Sequence[PyTree], problem: Problem, found: tuple[PyTree, ...], ended: tuple[Scalar, State]
) -> DAESolution:
    """The solution, with the code of what is wrong with it; `found`: what a look at its start and its end has shown, `ended`: where
    that is.
    """
    t0, t1, ts, ys, interpolation, stats, code, event_mask, seen = out
    start, end, (finite_end, defined) = found
    failed = lambda name, instead, when=True: RESULTS.where((code == name) & when, instead, code)
    if takes_residuals(solve.solver):
        code = failed(RESULTS.dt_min_reached, RESULTS.error_too_large)
        code = failed(RESULTS.nonlinear_divergence, RESULTS.no_convergence)
        code = failed(RESULTS.singular, RESULTS.singular_iteration_matrix)
    code = failed(RESULTS.dt_min_reached, RESULTS.step_rejected)
    code = failed(RESULTS.nonlinear_divergence, RESULTS.off_manifold)
    finite = [all_finite(*pair) for pair in _saved(solve.saveat, ts, ys)] if ts is not None else []
    outside = [_wrong_times(part, problem) for part in saved_parts(solve.saveat) if part.ts is not None]
    if _times_only(solve.saveat):
        # With `throw=False` nobody need look at the code, and these would pass for states.
        ys = jax.tree.map(functools.partial(without_rows, outside[0], jnp.nan), ys)
    precision = precision_of(t0.dtype, solve.controller)
    code = RESULTS.where(went_well(code) & ~jnp.all(jnp.stack([finite_end, *finite])), RESULTS.not_finite, code)
    # A root finder that met a condition that is not a number ends anywhere, also at a time that is none.
    lost = ~defined | ~jnp.isfinite(stats["end_time"])
    for name in ("nonlinear_max_steps_reached", "nonfinite_input", "nonfinite"):
        code = failed(getattr(RESULTS, name), RESULTS.undefined_condition, lost)
    if solve.event is not None:
        code = failed(RESULTS.nonlinear_max_steps_reached, RESULTS.event_not_located)
    okay = went_well(code)
    code = RESULTS.where(okay & ~defined, RESULTS.undefined_condition, code)
    stuck = [getattr(RESULTS, name) for name in _STUCK]
    stuck = jnp.any(jnp.stack([code == name for name in stuck]))
    code = RESULTS.where(stuck & end.singular, RESULTS.singular_configuration, code)
    code = RESULTS.where(okay & ~end.near, RESULTS.off_constraints, code)
    code = RESULTS.where(okay & jnp.any(jnp.concatenate([jnp.zeros(1, bool), *outside])), RESULTS.times_outside, code)
    code = RESULTS.where(end.masses & (end.masses_ahead | okay), code, RESULTS.irregular_mass)
    for wrong, name in enumerate(
        ("inconsistent_start", "dependent_constraints", "irregular_mass", "ambiguous_start"), 1
    ):
        code = RESULTS.where(start.wrong == wrong, getattr(RESULTS, name), code)
    defined = solve.formulation.is_defined()
    code = code if defined is True else RESULTS.where(jnp.asarray(defined), code, RESULTS.undefined_formulation)
    # diffrax has no step to take where its comparisons with NaN are false.
    defined = jnp.isfinite(problem.t0) & jnp.isfinite(problem.t1)
    code = RESULTS.where(defined, code, RESULTS.undefined_interval)
    rank = count_of(problem.rank)
    stats = {
        **stats,
        "doubts": jnp.where(went_well(code), doubts.found(solve, end.drifted, stats["num_accepted_steps"], *seen), 0),
    }
    return DAESolution(t0, t1, ts, ys, interpolation, stats, code, event_mask, problem.args, rank, precision, end=ended)


def _saved(saveat: diffrax.SaveAt, ts: PyTree[Array], ys: PyTree[Array]) -> list[tuple[Any, Any]]:
    """The (times, states) of each part of `saveat`."""
    structure = jax.tree.structure(saveat.subs, is_leaf=is_saved_part)
    return [
        (t, y) for t, y in zip(structure.flatten_up_to(ts), structure.flatten_up_to(ys), strict=True) if t is not None
    ]


def _wrong_times(part: diffrax.SubSaveAt, problem: Problem) -> Bool[Array, " times"]:
    """Which times to save at are beyond an end of the solve, which diffrax pads like a time that was not reached, come after a later
    one, to where it extrapolates, or are NaN, at which it saves no more.
    """
    low, high = jnp.minimum(problem.t0, problem.t1), jnp.maximum(problem.t0, problem.t1)
    ts = jnp.asarray(part.ts)
    back = jnp.where(problem.t1 < problem.t0, -1, 1) * jnp.diff(ts, prepend=ts[:1]) < 0
    return ~((ts >= low) & (ts <= high)) | back


def _times_only(saveat: diffrax.SaveAt) -> bool:
    """Whether `SaveAt(ts=...)` is all that is saved, so that states are along `ts`."""
    part = saveat.subs
    return is_saved_part(part) and part.ts is not None and not (part.t0 or part.t1 or part.steps)
