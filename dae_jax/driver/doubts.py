"""What makes an answer doubtful though no step has failed: bits of `stats["doubts"]`, and a warning in words."""

import enum
import warnings
from typing import TYPE_CHECKING

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..solution import AccuracyWarning, DAESolution
from ..types import BoolLike, BoolScalar, IntScalar, Scalar


if TYPE_CHECKING:
    from .program import Solve

# The errors of so many steps may add up to more than two digits are worth.
MANY, PART = 1_000_000, 0.01


class Doubt(enum.IntFlag):
    """Why an answer may be off by more than was asked for."""

    DRIFTED = 1
    UNRESOLVED = 2
    MANY_STEPS = 4
    PASSED = 8
    STEPPED_OVER = 16


_SENTENCES = {
    Doubt.DRIFTED: (
        "At its end the solution is off the constraints by more than a thousand tolerances: this formulation lets it drift, and "
        "more so the longer it goes on. Use a method that keeps the constraints, such as OrthogonalProjection(DOP853()); "
        "`dae_jax.drift` shows how far it is off."
    ),
    Doubt.UNRESOLVED: (
        "The fixed steps are too large: their errors, as the method estimates them, add up to more than the solution itself, as "
        "they do beyond a method's limit of stability. Take smaller steps, or let them be chosen (`dt0=None`, no `dtmin`)."
    ),
    Doubt.MANY_STEPS: (
        "A million steps and more were taken, and the errors that the tolerance allows in each of them may add up to more than a "
        "hundredth of the solution. Use a smaller tolerance or a method of higher order, and compare."
    ),
    Doubt.PASSED: (
        "On its way the solution has passed a configuration in which the constraints depend on each other, such as a dead centre, or "
        "the equations do not determine all derivatives, as at a fold, or a mass is negative, or has drifted so far that it may be on "
        "the wrong side of one: there it may go on in another way, or end. (Steps in which the constraints turn by more than a right "
        "angle are taken for such a passage too.) Look whether it goes on as is meant; a method that keeps the constraints and smaller "
        "tolerances or steps tell what comes near one from what passes it."
    ),
    Doubt.STEPPED_OVER: (
        "In a step the equations switch more than once with time (as `t % period < width` does): a pulse between the points at which "
        "a method evaluates them is stepped over, and leaves no trace in the estimate of the error. Make the times known at which they "
        "switch, `diffrax.ClipStepSizeController(controller, jump_ts=times)`, or take steps shorter than a pulse (`dtmax`, `dt0`)."
    ),
}


def found(
    solve: "Solve",
    drifted: BoolScalar,
    steps: IntScalar,
    errors: Scalar | None,
    passed: BoolLike,
    stepped_over: BoolLike,
) -> Int[Array, ""]:
    """The doubts about a solve that went well, as bits; `errors`: of all steps that may be too large, as parts of the solution; `passed`:
    a configuration in which the constraints depend on each other; `stepped_over`: what switched in a step, with time, and back.
    """
    many = jnp.asarray(False)
    if isinstance(solve.controller, diffrax.AbstractAdaptiveStepSizeController):
        rtol = jnp.max(jnp.asarray(getattr(solve.controller, "rtol")))  # noqa: B009
        many = (steps >= MANY) & (steps * rtol > PART)
    unresolved = jnp.asarray(False) if errors is None else errors > 1
    bits = {
        Doubt.DRIFTED: drifted,
        Doubt.UNRESOLVED: unresolved,
        Doubt.MANY_STEPS: many,
        Doubt.PASSED: passed,
        Doubt.STEPPED_OVER: stepped_over,
    }
    return sum((jnp.where(on, int(bit), 0) for bit, on in bits.items()), jnp.zeros((), int))


def warn(sol: DAESolution, stacklevel: int) -> None:
    """Warns of the doubts about a solution that consists of numbers."""
    doubts = int(np.asarray(sol.stats["doubts"]))
    for bit, sentence in _SENTENCES.items():
        if doubts & bit:
            warnings.warn(sentence, AccuracyWarning, stacklevel=stacklevel + 1)
