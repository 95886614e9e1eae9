"""How a solve that failed says so: the sentence, and how it gets out of a compiled program."""

import logging
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree

from .._compat import CALLBACK_LOG, messages, unvmap_any
from ..consistent import Violation, violation
from ..equations.mechanical import MechanicalODE
from ..equations.singular_block import singular_block
from ..solution import RESULTS, DAESolution
from ..systems import is_mechanism
from ..types import BoolScalar
from .problem import Problem
from .start import ADVICE


OKAY = tuple(int(code._value) for code in (RESULTS.successful, RESULTS.event_occurred))
# Failures that are found at the start, whatever steps were taken.
_AT_START = tuple(
    int(code._value) for code in (RESULTS.inconsistent_start, RESULTS.dependent_constraints, RESULTS.no_finite_start)
)


class SolveFailed(RuntimeError):
    """A solve failed in a compiled program (`jit`, `vmap`). JAX hands it on as the last line of an error of its own."""


def in_words(sol: DAESolution, problem: Problem | None = None) -> str | None:
    """Why a solve failed, at which time and after how many steps, and of a known `problem` what its start violates; `None` where
    it did not.
    """
    off = problem and _off(eqx.combine(lax.stop_gradient(eqx.filter(problem, eqx.is_array)), problem))
    return _sentence(tuple(map(np.asarray, lax.stop_gradient(_details(sol)))), off)


def undetermined(sol: DAESolution, problem: Problem) -> str:
    """Which unknowns the equations do not determine where a solve ended with a singular iteration matrix, or at its start; empty
    where that was not the failure, or nothing is found.
    """
    if sol.result != RESULTS.singular_iteration_matrix:
        return ""
    system, t0, y0, args = problem.start
    points = [(t0, y0)]
    if sol.ys is not None and jax.tree.structure(sol.ys) == jax.tree.structure(y0):
        finite = [np.isfinite(x).reshape(len(x), -1).all(1) for x in (sol.ts, *jax.tree.leaves(sol.ys))]
        reached = np.flatnonzero(np.all(finite, 0))[-1:]
        points = [(sol.ts[k], jax.tree.map(lambda y, k=k: y[k], sol.ys)) for k in reached] + points
    return next(filter(None, (singular_block(system, t, y, args) for t, y in points)), "")


def _details(sol: DAESolution) -> tuple[Any, ...]:
    return sol.result._value, sol.stats["end_time"], sol.t0, sol.t1, sol.stats["num_steps"]


def _sentence(details: tuple[np.ndarray, ...], off: Violation | None) -> str | None:
    """The sentence for numbers, or for arrays of a batch: that of the first of those that failed; `off`: how far its start is from
    the constraints.
    """
    code, end, t0, t1, steps = details
    failed = np.flatnonzero(~np.isin(code, OKAY))
    if not failed.size:
        return None
    at = lambda x: np.broadcast_to(x, np.shape(code)).reshape(-1)[failed[0]]
    said = messages(RESULTS)[int(at(code))]
    if off is not None and int(at(code)) == int(RESULTS.inconsistent_start._value):
        said = _of_one(off, failed[0], np.ndim(code)).message() + ADVICE
    if int(at(code)) not in _AT_START:
        said += f" The solve from t = {at(t0):.6g} to {at(t1):.6g} ended at t = {at(end):.6g} after {at(steps)} steps."
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


def raised_in_the_program(sol: DAESolution, problem: Problem) -> DAESolution:
    """`sol` of a problem, in a program in which it raises a `SolveFailed` where it is evaluated and has failed."""
    okay = jnp.any(jnp.stack([sol.result._value == code for code in OKAY]))
    arrays, rest = eqx.partition(sol, eqx.is_array)
    details = jax.tree.map(jnp.asarray, lax.stop_gradient(_details(sol)))
    start = lax.stop_gradient(eqx.filter(problem, eqx.is_array)), eqx.filter(problem, eqx.is_array, inverse=True)
    return eqx.combine(_passed(arrays, ~okay, details, start), rest)


# A custom derivative, so that the branch is none in a derivative, which fails where the solve does also if only it is asked for.
@eqx.filter_custom_jvp
def _passed(arrays: PyTree[Array], failed: BoolScalar, details: tuple[Array, ...], start: tuple[PyTree, PyTree]) -> Any:
    shapes = jax.eval_shape(lambda: arrays)
    fail = lambda: jax.pure_callback(_raise, shapes, _off(eqx.combine(*start)), *details, vmap_method="expand_dims")
    return lax.cond(unvmap_any(failed), fail, lambda: arrays)


@_passed.def_jvp
def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    one = _passed(jnp.ones(()), *primals[1:])
    return _passed(*primals), jax.tree.map(lambda tangent: tangent * one.astype(tangent.dtype), tangents[0])


def _off(problem: Problem) -> Violation | None:
    """By how much a mechanism violates its constraints at the start: worth to be computed only where a solve has failed."""
    system, t, state, args = problem.start
    if not is_mechanism(system):
        return None
    ode = MechanicalODE.of(system, t, state, args, problem.rank)
    return jax.tree.map(jnp.asarray, violation(ode, t, ode.encode(state)))


def _raise(off: Violation | None, *details: Array | np.ndarray) -> Any:
    # JAX would print the traceback of this function before the error that has it.
    logging.getLogger(CALLBACK_LOG).addFilter(_without_ours)
    raise SolveFailed(_sentence(tuple(map(np.asarray, details)), off))


def _without_ours(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], SolveFailed))


def sentence_of(error: BaseException) -> str | None:
    """What a `SolveFailed` said that JAX hands on as `error`, without the place in a batch; `None` for other errors."""
    _, found, sentence = str(error).rpartition(f"{SolveFailed.__name__}: ")
    return re.sub(r"^\d+ of a batch of .*?: ", "", sentence).strip() if found else None
