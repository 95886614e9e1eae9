"""What a solver can do, asked of its interface: also of one that is written outside of this package."""

import dataclasses
from typing import Any

import diffrax
from typing_extensions import TypeIs

from .explicit import unrolled
from .manifold import AbstractManifoldSolver
from .replay import Replayable
from .residual_steps import AbstractResidualSolver


def economical(solver: diffrax.AbstractSolver, between: bool) -> Any:
    """The solver without what a solve does not need, with its stages written out; `between`: points between steps are asked
    for.
    """
    changed: dict[str, Any] = {}
    if any(field.name == "dense" for field in dataclasses.fields(solver)):
        changed["dense"] = between
    inner = getattr(solver, "solver", None)
    if inner is not None and isinstance(solver, AbstractManifoldSolver | AbstractResidualSolver):
        changed["solver"] = economical(inner, between)
    return dataclasses.replace(solver, **changed) if changed else unrolled(solver)


def is_explicit(solver: diffrax.AbstractSolver) -> bool:
    """Whether a solver is an explicit Runge–Kutta method whose stages can be taken elsewhere than its state."""
    return hasattr(unrolled(solver), "step_and_retract")


def is_recomputable(solver: diffrax.AbstractSolver) -> bool:
    """Whether a step can be done once more from its start alone."""
    return is_explicit(solver) or getattr(solver, "recomputable", False)


def replays(solver: diffrax.AbstractSolver) -> bool:
    """Whether a step can be done once more, for its derivative, from its dense output."""
    inner = getattr(solver, "solver", None)
    return isinstance(solver, Replayable) and (inner is None or is_explicit(inner) or replays(inner))


def takes_residuals(solver: diffrax.AbstractSolver) -> TypeIs[AbstractResidualSolver]:
    """Whether a solver works on 0 = F(t, y, ẏ) in place of an ODE."""
    return isinstance(solver, AbstractResidualSolver)


def counts(solver: diffrax.AbstractSolver) -> tuple[str, ...]:
    """Which entries of the solver's state at the end of a solve are counts for `stats`, by their paths."""
    return getattr(solver, "counts", ())
