"""How to solve: options of a wrong type, and methods that do not fit each other, are refused in a sentence."""

import functools
import typing
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np
import optimistix

from ._compat import use_stepsize_tol
from .formulations import AbstractFormulation, Baumgarte, Differentiation, DummyDerivatives, Residual, StateSpace
from .jumps import Jump
from .solvers import (
    RATTLE,
    AbstractManifoldSolver,
    AbstractResidualSolver,
    TangentSpace,
    unrolled,
)
from .states import NUMBERS, brief
from .systems import ConstrainedSystem


EXPECTED = {
    "saveat": (diffrax.SaveAt, "a diffrax.SaveAt such as diffrax.SaveAt(ts=jnp.linspace(t0, t1, 101))"),
    "stepsize_controller": (
        (diffrax.AbstractStepSizeController, type(None)),
        "a step-size controller such as diffrax.PIDController(rtol=1e-6, atol=1e-6)",
    ),
    "adjoint": (diffrax.AbstractAdjoint, "a diffrax adjoint such as diffrax.ForwardMode()"),
    "event": (
        (diffrax.Event, Jump, type(None)),
        "a diffrax.Event(condition), which ends the solve, or a dae_jax.Jump(condition, jump), after which it goes on",
    ),
    "progress_meter": (diffrax.AbstractProgressMeter, "a progress meter such as diffrax.TqdmProgressMeter()"),
}


def refuse_wrong_options(
    saveat: Any, controller: Any, adjoint: Any, event: Any, max_steps: Any, progress_meter: Any
) -> None:
    """Refuses options that are not what diffrax takes."""
    given = (saveat, controller, adjoint, event, progress_meter)
    _refuse_wrong_types(tuple(map(type, given)), given)
    if max_steps is not None and (type(max_steps) is not int or max_steps < 1):
        raise ValueError(
            f"`max_steps` must be an integer of at least 1, or None for no limit, but is {brief(max_steps)}."
        )
    if type(adjoint) in (diffrax.BacksolveAdjoint, diffrax.ImplicitAdjoint):
        raise ValueError(
            f"`adjoint` must not be {type(adjoint).__name__}, which knows nothing of the constraints: use the default, "
            "RecursiveCheckpointAdjoint(), for reverse mode, and ForwardMode() for forward mode."
        )
    if type(event) is diffrax.Event and not isinstance(event.root_finder, optimistix.AbstractRootFinder | None):
        raise TypeError(
            "`root_finder` of diffrax.Event must be a root finder such as optimistix.Newton(1e-8, 1e-8), but is "
            f"{brief(event.root_finder)}."
        )
    _refuse_bad_tolerances(controller)


_right_types: set[tuple[type, ...]] = set()


def _refuse_wrong_types(types: tuple[type, ...], given: tuple[Any, ...]) -> None:
    # Looked up, as asking is slow: diffrax's classes are abstract ones.
    if types in _right_types:
        return
    for (name, (kind, what)), value in zip(EXPECTED.items(), given, strict=True):
        if not isinstance(value, kind):
            raise TypeError(f"`{name}` must be {what}, but is {brief(value)}.")
    _right_types.add(types)


def _refuse_bad_tolerances(controller: Any) -> None:
    if type(controller) is not diffrax.PIDController:
        return
    given = [controller.rtol, controller.atol]
    if all(type(x) is float and x > 0 for x in given) or any(
        isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(given)
    ):
        return
    leaves = jax.tree.leaves(given)
    fine = all(isinstance(x, NUMBERS) and np.all(np.asarray(x) >= 0) for x in leaves)
    if not fine or not any(np.any(x) for x in leaves):
        raise ValueError(
            "`stepsize_controller` must have positive tolerances, but has "
            f"rtol = {brief(given[0])} and atol = {brief(given[1])}: write PIDController(rtol=1e-6, atol=1e-6)."
        )


def refuse_misfits(system: Any, formulation: Any, solver: Any, t0: Any, y0: Any, args: Any) -> None:
    """Refuses pairs of formulation and solver that make no sense, and shapes that do not fit."""
    refuse_no_solver(solver)
    if not isinstance(formulation, AbstractFormulation):
        other = ": give it as `solver`" if isinstance(formulation, diffrax.AbstractSolver) else ""
        raise TypeError(
            f"`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is {brief(formulation)}{other}."
        )
    name = type(solver).__name__
    if takes_residuals(solver) and not isinstance(formulation, Residual | DummyDerivatives):
        raise ValueError(
            f"{name} solves 0 = F(t, y, ẏ) as it is written, and takes no {type(formulation).__name__}: use "
            "`formulation=dae_jax.Residual()`, or no `formulation`."
        )
    if isinstance(formulation, Residual) and not takes_residuals(solver):
        raise ValueError(
            f"{name} needs an ODE, and Residual is none: solve it with RadauIIA5() or BDF(), or use {name} with "
            "Differentiation()."
        )
    fits = takes_residuals(solver) or hasattr(unrolled(solver), "landing_step")
    if isinstance(formulation, DummyDerivatives) and not fits:
        raise ValueError(
            "DummyDerivatives takes an explicit Runge–Kutta solver such as DOP853(), RadauIIA5() or BDF(), but got "
            f"{brief(solver)}."
        )
    if isinstance(formulation, StateSpace) and not isinstance(system, ConstrainedSystem):
        raise ValueError("StateSpace takes a ConstrainedSystem: its chart gives the positions of a mechanism.")
    if isinstance(formulation, StateSpace) and isinstance(solver, AbstractManifoldSolver):
        raise ValueError(
            f"StateSpace has no constraints left for {name} to keep: in its chart they hold by "
            "construction. Use the inner solver itself."
        )
    if isinstance(formulation, Baumgarte) and (np.shape(formulation.alpha) or np.shape(formulation.beta)):
        raise ValueError(
            f"`alpha` and `beta` of Baumgarte must be numbers, but have the shapes {np.shape(formulation.alpha)} and "
            f"{np.shape(formulation.beta)}: batch over them with `jax.vmap`."
        )
    if isinstance(solver, RATTLE):
        _fits_rattle(system, formulation, t0, y0, args)


def refuse_no_solver(solver: Any) -> None:
    """Refuses what is no solver of ODEs or of residuals."""
    if not isinstance(solver, diffrax.AbstractSolver):
        other = ": give it as `formulation`" if isinstance(solver, AbstractFormulation) else ""
        raise TypeError(f"`solver` must be a diffrax solver such as diffrax.Tsit5(), but is {brief(solver)}{other}.")
    if not _takes_one_ode(solver.term_structure):
        raise ValueError(
            f"`solver` must be one for ẏ = f(t, y), but {type(solver).__name__} needs equations that are split or have noise: "
            "use diffrax.Tsit5(), dae_jax.RadauIIA5() for stiff equations, or dae_jax.RATTLE() for a symplectic method."
        )


@functools.lru_cache
def _takes_one_ode(term_structure: Any) -> bool:
    kind = typing.get_origin(term_structure) or term_structure
    return isinstance(kind, type) and issubclass(diffrax.ODETerm, kind)


def refuse_other_steps(solver: Any, controller: Any, dt0: Any) -> None:
    """Refuses a step-size control that the solver cannot have."""
    name, adapts = type(solver).__name__, isinstance(solver, diffrax.AbstractAdaptiveSolver)
    if dt0 is None and not adapts:
        raise ValueError(f"`dt0` must be given: {name} takes fixed steps.")
    if dt0 is None and isinstance(controller, diffrax.ConstantStepSize):
        raise ValueError("`dt0` must be given: ConstantStepSize takes steps of that size.")
    inner = getattr(solver, "solver", solver)
    if isinstance(controller, diffrax.ConstantStepSize | None) and dt0 is not None and _has_no_tolerance(inner):
        raise ValueError(
            f"`solver`: {type(inner).__name__} must know how well to solve its equations where steps are fixed: give it "
            "`root_finder=diffrax.VeryChord(rtol=1e-10, atol=1e-10)`, or leave out `dt0`."
        )
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) and not adapts:
        raise ValueError(
            f"`stepsize_controller` must not be {type(controller).__name__}, as {name} estimates no error: leave it out and "
            "give `dt0`, or use a solver with an error estimate such as Tsit5."
        )


def _has_no_tolerance(solver: Any) -> bool:
    """Whether an implicit solver of diffrax takes its tolerances from the step-size control."""
    finder = getattr(solver, "root_finder", None)
    return finder is not None and getattr(finder, "rtol", None) is use_stepsize_tol


def refuse_no_event(solver: Any) -> None:
    """Refuses solvers whose dense output diffrax cannot look for an event on."""
    if isinstance(solver, TangentSpace):
        raise ValueError(
            "Events need a solution between steps in the coordinates of the step, which the local coordinates of TangentSpace "
            "and of DummyDerivatives with an explicit solver are not; use OrthogonalProjection, RadauIIA5 or BDF."
        )


def _fits_rattle(system: ConstrainedSystem, formulation: Any, t0: Any, y0: Any, args: Any) -> None:
    if not isinstance(system, ConstrainedSystem):
        raise ValueError("RATTLE takes a ConstrainedSystem; use SymmetricProjection for other systems.")
    if callable(system.mass):
        raise ValueError("RATTLE needs a constant mass matrix, but `mass` is a function; use SymmetricProjection.")
    if system.nonholonomic is not None:
        raise ValueError("RATTLE takes holonomic constraints only; use SymmetricProjection for nonholonomic ones.")
    if not isinstance(formulation, Differentiation):
        raise ValueError(f"RATTLE has its own treatment of the constraints and takes no {type(formulation).__name__}.")
    q, v = y0
    arrays, static = eqx.partition(args, eqx.is_array)
    jaxpr = jax.make_jaxpr(lambda v, q, a: system.force(t0, q, v, eqx.combine(a, static)))(v, q, arrays).jaxpr
    velocities = jaxpr.invars[: len(jax.tree.leaves(v))]
    used = [x for eqn in jaxpr.eqns for x in eqn.invars] + list(jaxpr.outvars)
    if any(x is velocity for x in used for velocity in velocities):
        raise ValueError("RATTLE needs a force that does not depend on v; use SymmetricProjection.")


def takes_residuals(solver: Any) -> bool:
    """Whether a solver works on 0 = F(t, y, ẏ) in place of an ODE."""
    return isinstance(solver, AbstractResidualSolver)
