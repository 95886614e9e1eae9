"""How a solve that failed says so: the sentence, and how it gets out of a compiled program."""

import functools
import logging
import re
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._compat import CALLBACK_LOG, messages, unvmap_any
from ..consistent import Violation, violation
from ..equations.linearised import LinearisedResidual
from ..equations.manifold_ode import constant
from ..equations.mechanical import MechanicalODE
from ..equations.residual_form import ResidualForm
from ..equations.singular_block import singular_block
from ..solution import RESULTS, DAESolution, went_well
from ..systems import is_mechanism
from ..types import BoolScalar
from ..validate.user_functions import not_finite
from .followed_steps import Steps, of_bits, reach
from .problem import Problem, Program, split
from .start import ADVICE
from .tolerances import NAMES, of_state


OKAY = tuple(int(code._value) for code in (RESULTS.successful, RESULTS.event_occurred))
# Failures that are found at the start, whatever steps were taken.
_AT_START = tuple(
    int(code._value)
    for code in (
        RESULTS.inconsistent_start,
        RESULTS.dependent_constraints,
        RESULTS.no_finite_start,
        RESULTS.undefined_formulation,
    )
)


_OF_A_STEP = tuple(
    int(code._value)
    for code in (
        RESULTS.step_rejected, RESULTS.off_manifold, RESULTS.no_convergence, RESULTS.error_too_large,
        RESULTS.singular_iteration_matrix, RESULTS.singular_configuration, RESULTS.not_finite, RESULTS.max_steps_reached,
    )
)  # fmt: skip
# At which parts of the interval beyond its end a solve that failed is looked at.
BEYOND = (0.0, 1e-9, 1e-6, 1e-3)


class SolveFailed(RuntimeError):
    """A solve failed in a compiled program (`jit`, `vmap`), or the derivative of one. JAX hands it on as the last line of an error of its
    own.
    """


def in_words(sol: DAESolution, problem: Problem | None = None) -> str | None:
    """Why a solve failed, at which time and after how many steps, and of a known `problem` what its start violates; `None` where
    it did not.
    """
    off = None
    if problem is not None:
        program, numbers = split(problem)
        off = _off(program, lax.stop_gradient(numbers))
    return _sentence(tuple(map(np.asarray, lax.stop_gradient(_details(sol)))), off)


def undetermined(sol: DAESolution, problem: Problem) -> str:
    """Which unknowns the equations do not determine where a solve ended with a singular iteration matrix, or at its start; empty
    where that was not the failure, or nothing is found.
    """
    if sol.result != RESULTS.singular_iteration_matrix:
        return ""
    system, t0, y0, args = problem.start
    return next(filter(None, (singular_block(system, t, y, args) for t, y in (sol.end, (t0, y0)))), "")


def not_finite_beyond(sol: DAESolution, problem: Problem) -> str:
    """Which functions are not finite a little beyond the point at which a solve found no next step; empty where all are."""
    if int(sol.result._value) not in _OF_A_STEP:
        return ""
    (t, y), t0, t1, (system, _, y0, args) = constant((sol.end, sol.t0, sol.t1, problem.start))
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((t, y, args))):
        return ""
    # Steps that are taken whatever comes of them may have led to no state.
    y = y if all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(y)) else y0
    flat, unflatten = ravel_pytree(y)
    if is_mechanism(system):
        slope = ravel_pytree((y[1], jax.tree.map(jnp.zeros_like, y[1])))[0]
    else:
        form = ResidualForm.of(system, t, y, args)
        flat_y = form.encode(y)
        slope = ravel_pytree(form.decode(t, LinearisedResidual.of(form, flat_y).ydot(t, flat_y)))[0]
    slope = jnp.where(jnp.isfinite(slope), slope, 0)
    for part in BEYOND:
        ahead = part * (t1 - t0)
        found = not_finite(system, t + ahead, unflatten(flat + ahead * slope), args, f"just beyond t = {float(t):.6g}")
        if found:
            return found
    return ""


def below_roundoff(sol: DAESolution, controller: diffrax.AbstractStepSizeController) -> str:
    """That no step can meet the tolerances, where that is so at the end of a solve that found none; else empty."""
    state = lax.stop_gradient(sol.end[1])
    tolerances = [lax.stop_gradient(of_state(controller, name, state)) for name in NAMES]
    adapts = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    known = adapts and not any(isinstance(x, Tracer) for x in jax.tree.leaves((tolerances, state)))
    if int(sol.result._value) not in _OF_A_STEP or not known:
        return ""
    each = zip(*map(jax.tree.leaves, (state, *tolerances)), strict=True)
    whole = [np.stack(np.broadcast_arrays(np.abs(x), *of)).reshape(3, -1) for x, *of in each]
    size, rtol, atol = np.concatenate(whole, 1)
    eps = float(np.finfo(jnp.result_type(*jax.tree.leaves(state))).eps)
    below = rtol * size + atol < eps * size
    if not np.any(below):
        return ""
    worst = np.argmax(size * below)
    return (
        f"The tolerances, rtol = {rtol[worst]:.3g} and atol = {atol[worst]:.3g}, are below round-off, which is {eps:.2g} of a number: "
        "no step meets them."
    )


def _details(sol: DAESolution) -> tuple[Any, ...]:
    return sol.result._value, sol.stats["end_time"], sol.t0, sol.t1, sol.stats["num_steps"], sol.stats.get("jumps", 0)


def _sentence(details: tuple[np.ndarray, ...], off: Violation | None) -> str | None:
    """The sentence for numbers, or for arrays of a batch: that of the first of those that failed; `off`: how far its start is from
    the constraints.
    """
    code, end, t0, t1, steps, resets = details
    failed = np.flatnonzero(~np.isin(code, OKAY))
    if not failed.size:
        return None
    at = lambda x: np.broadcast_to(x, np.shape(code)).reshape(-1)[failed[0]]
    said = messages(RESULTS)[int(at(code))]
    if off is not None and int(at(code)) == int(RESULTS.inconsistent_start._value):
        said = _of_one(off, failed[0], np.ndim(code)).message() + ADVICE
    if int(at(code)) not in _AT_START:
        said += f" The solve from t = {at(t0):.6g} to {at(t1):.6g} ended at t = {at(end):.6g} after {at(steps)} steps."
    elif int(at(resets)):
        said += f" The start meant is that after reset {at(resets)}, at t = {at(end):.6g}."
    if np.asarray(t0).dtype == np.float32:
        said += (
            " It ran in float32, which resolves 1.2e-07 of a number: for more, switch on float64 by "
            '`jax.config.update("jax_enable_x64", True)` right after the imports.'
        )
    if np.size(code) > 1:
        said = (
            f"{failed.size} of a batch of {np.size(code)} solves failed, the first of them number {failed[0]}: {said}"
        )
    return said


def _of_one(off: Violation, number: int, axes: int) -> Violation:
    """That of one of a batch of so many axes, in each of which an array may be of length 1."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[axes:])[number if x.shape[:axes] != (1,) * axes else 0], off)


def raised_in_the_program(sol: DAESolution, problem: Problem, off: Violation | None) -> DAESolution:
    """`sol` of a problem, in a program in which it raises a `SolveFailed` where it is evaluated and has failed; `off`: how far its
    start is from the constraints, if that is known.
    """
    okay = went_well(sol.result)
    arrays, rest = eqx.partition(sol, eqx.is_array)
    details = jax.tree.map(jnp.asarray, lax.stop_gradient(_details(sol)))
    find, numbers = _as_it_is, off
    if off is None:
        # Apart, as functions of the problem may close over what is traced.
        program, numbers = split(problem)
        find = functools.partial(_off, program)
    return eqx.combine(_passed(arrays, ~okay, details, find, lax.stop_gradient(numbers)), rest)


def _as_it_is(off: Violation) -> Violation:
    return off


# A custom derivative, so that the branch is none in a derivative, which fails where the solve does also if only it is asked for.
@eqx.filter_custom_jvp
def _passed(
    arrays: PyTree[Array],
    failed: BoolScalar,
    details: tuple[Array, ...],
    find: Callable[[Any], Violation | None],
    start: PyTree[Array],
) -> Any:
    shapes = jax.eval_shape(lambda: arrays)

    def fail() -> Any:
        raised = jax.pure_callback(_raise_of, shapes, find(start), *details, vmap_method="expand_dims")
        # Within `jax.shard_map` they vary from device to device as the arrays do.
        return jax.tree.map(lambda x, of: jnp.where(True, x, of), raised, arrays)

    return lax.cond(unvmap_any(failed), fail, lambda: arrays)


@_passed.def_jvp
def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    one = _passed(jnp.ones(()), *primals[1:])
    return _passed(*primals), jax.tree.map(lambda tangent: tangent * one.astype(tangent.dtype), tangents[0])


def refused_on_the_way(steps: Steps, most: int) -> Steps:
    """The steps of a derivative, at most so many, in a program in which it raises a `SolveFailed` where they do not lead to the end."""
    sentence = (
        "The derivative of a solve is not known: its steps, which are shorter than those of the solution where it needs that, do not "
        f"lead to the end. Raise `max_steps`, which is {most}. With `throw=False` the derivative is NaN instead."
    )
    return steps._replace(times=refused_where(~reach(of_bits(steps)), sentence, steps.times))


def refused_where(wrong: BoolScalar, sentence: str, x: Array) -> Array:
    """A vector x in a program in which it raises a `SolveFailed` where something is `wrong`."""
    fail = lambda: jax.pure_callback(functools.partial(_raise, sentence), jnp.zeros((), int))
    none = lax.cond(unvmap_any(wrong), fail, lambda: jnp.zeros((), int))
    return x.at[0].add(none.astype(x.dtype))


def _off(program: Program, numbers: list[Array]) -> Violation | None:
    """By how much a mechanism violates its constraints at the start: worth to be computed only where a solve has failed."""
    problem: Problem = program.whole(numbers)
    system, t, state, args = problem.start
    if not is_mechanism(system):
        return None
    ode = MechanicalODE.of(system, t, state, args, problem.rank)
    return jax.tree.map(jnp.asarray, violation(ode, t, ode.encode(state)))


def _raise_of(off: Violation | None, *details: Array | np.ndarray) -> Any:
    _raise(_sentence(tuple(map(np.asarray, details)), off))


def _raise(sentence: str | None) -> Any:
    # JAX would print the traceback of this function before the error that has it.
    logging.getLogger(CALLBACK_LOG).addFilter(_without_ours)
    raise SolveFailed(sentence)


def _without_ours(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], SolveFailed))


def sentence_of(error: BaseException) -> str | None:
    """What a `SolveFailed` said that JAX hands on as `error`, without the place in a batch; `None` for other errors."""
    _, found, sentence = str(error).rpartition(f"{SolveFailed.__name__}: ")
    return re.sub(r"^\d+ of a batch of .*?: ", "", sentence).strip() if found else None
