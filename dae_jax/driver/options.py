"""How to solve: options of a wrong type, and methods that do not fit each other, are refused in a sentence."""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import diffrax
import optimistix

from .._compat import use_stepsize_tol
from ..formulations import AbstractFormulation, AbstractResidualFormulation
from ..solvers import AbstractManifoldSolver, is_explicit, takes_residuals
from ..types import Time
from ..validate.states import brief
from .resets import Reset


P = ParamSpec("P")
T = TypeVar("T")

EXPECTED = {
    "saveat": (diffrax.SaveAt, "a diffrax.SaveAt such as diffrax.SaveAt(ts=jnp.linspace(t0, t1, 101))"),
    "stepsize_controller": (
        (diffrax.AbstractStepSizeController, type(None)),
        "a step-size controller such as diffrax.PIDController(rtol=1e-6, atol=1e-6)",
    ),
    "adjoint": (diffrax.AbstractAdjoint, "a diffrax adjoint such as diffrax.ForwardMode()"),
    "event": (
        (diffrax.Event, Reset, type(None)),
        "a diffrax.Event(condition), which ends the solve, or a dae_jax.Reset(condition, reset), after which it goes on",
    ),
    "progress_meter": (diffrax.AbstractProgressMeter, "a progress meter such as diffrax.TqdmProgressMeter()"),
}


# What others call what goes by another name here.
ELSEWHERE = {
    "rtol": "a tolerance goes into `stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6)`",
    "atol": "a tolerance goes into `stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6)`",
    "dt": "a fixed step is `dt0`",
    "ts": "times to save at go into `saveat=diffrax.SaveAt(ts=...)`",
    "t_eval": "times to save at go into `saveat=diffrax.SaveAt(ts=...)`",
    "method": "a method is the second argument, such as dae_jax.RadauIIA5()",
    "controller": "a step-size controller is `stepsize_controller`",
    "events": "an event is `event`, or several in one diffrax.Event",
}
ELSEWHERE |= {"tol": ELSEWHERE["rtol"], "t_span": "the order is system, solver, t0, t1, dt0, y0, args"}


def with_known_options(fn: Callable[P, T]) -> Callable[P, T]:
    """`fn`, which says of an argument that it does not know by which one to say that."""
    known = list(inspect.signature(fn).parameters)

    @functools.wraps(fn)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        unknown = kwargs.keys() - set(known)
        if unknown:
            name = min(unknown, key=lambda name: (name not in ELSEWHERE, name))
            advice = ELSEWHERE.get(name) or f"there are {', '.join(f'`{x}`' for x in known)}"
            raise TypeError(f"`{getattr(fn, '__name__', fn)}` has no argument `{name}`: {advice}.")
        return fn(*args, **kwargs)

    return called


def refuse_wrong_options(
    saveat: object, controller: object, adjoint: object, event: object, max_steps: object, progress_meter: object
) -> None:
    """Refuses options that are not what diffrax takes."""
    given = (saveat, controller, adjoint, event, progress_meter)
    _refuse_wrong_types(tuple(map(type, given)), given)
    inside = [name for name in ("solver_state", "controller_state", "made_jump") if getattr(saveat, name)]
    if inside:
        raise ValueError(
            f"`saveat` must not ask for {' and '.join(inside)}, which a solution does not keep: go on with `y0=sol.final`."
        )
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


_right_types: set[tuple[type, ...]] = set()


def _refuse_wrong_types(types: tuple[type, ...], given: tuple[object, ...]) -> None:
    # Looked up, as asking is slow: diffrax's classes are abstract ones.
    if types in _right_types:
        return
    for (name, (kind, what)), value in zip(EXPECTED.items(), given, strict=True):
        if not isinstance(value, kind):
            raise TypeError(f"`{name}` must be {what}, but is {brief(value)}.")
    _right_types.add(types)


def refuse_misfits(formulation: AbstractFormulation, solver: diffrax.AbstractSolver) -> None:
    """Refuses pairs of formulation and solver that make no sense."""
    refuse_no_solver(solver)
    if not isinstance(formulation, AbstractFormulation):
        other = ": give it as `solver`" if isinstance(formulation, diffrax.AbstractSolver) else ""
        raise TypeError(
            f"`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is {brief(formulation)}{other}."
        )
    name, residuals = type(solver).__name__, takes_residuals(solver)
    is_residual, selects = isinstance(formulation, AbstractResidualFormulation), formulation.selects_states
    if residuals and not (is_residual or selects):
        raise ValueError(
            f"{name} solves 0 = F(t, y, ẏ) as it is written, and takes no {type(formulation).__name__}: use "
            "`formulation=dae_jax.Residual()`, or no `formulation`."
        )
    if is_residual and not residuals:
        raise ValueError(
            f"{name} needs an ODE, and a residual 0 = F(t, y, ẏ), as GGL() and Residual(...) make it, is none: solve it with "
            f"RadauIIA5() or BDF(), or use {name} with Differentiation()."
        )
    if selects and not (residuals or is_explicit(solver)):
        raise ValueError(
            f"{type(formulation).__name__} takes an explicit Runge–Kutta solver such as DOP853(), RadauIIA5() or BDF(), but "
            f"got {brief(solver)}."
        )
    if not formulation.leaves_constraints and isinstance(solver, AbstractManifoldSolver):
        raise ValueError(
            f"{type(formulation).__name__} has no constraints left for {name} to keep: in its chart they hold by "
            "construction. Use the inner solver itself."
        )


def refuse_no_solver(solver: object) -> None:
    """Refuses what is no solver of ODEs or of residuals."""
    if not isinstance(solver, diffrax.AbstractSolver):
        other = ": give it as `formulation`" if isinstance(solver, AbstractFormulation) else ""
        raise TypeError(
            "`solver` must be one of dae_jax or of diffrax, such as OrthogonalProjection(DOP853()), RadauIIA5() or diffrax.Tsit5(), but is "
            f"{brief(solver)}{other}."
        )
    if not (takes_residuals(solver) or _takes_one_ode(solver.term_structure)):
        raise ValueError(
            f"`solver` must be one for ẏ = f(t, y), but {type(solver).__name__} needs equations that are split or have noise: "
            "use diffrax.Tsit5(), dae_jax.RadauIIA5() for stiff equations, or dae_jax.RATTLE() for a symplectic method."
        )


@functools.lru_cache
def _takes_one_ode(term_structure: object) -> bool:
    kind = typing.get_origin(term_structure) or term_structure
    return isinstance(kind, type) and issubclass(diffrax.ODETerm, kind)


def refuse_other_steps(
    solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController | None, dt0: Time | None
) -> None:
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


def _has_no_tolerance(solver: diffrax.AbstractSolver) -> bool:
    """Whether an implicit solver of diffrax takes its tolerances from the step-size control."""
    finder = getattr(solver, "root_finder", None)
    return finder is not None and getattr(finder, "rtol", None) is use_stepsize_tol


def refuse_no_event(solver: diffrax.AbstractSolver) -> None:
    """Refuses solvers whose dense output diffrax cannot look for an event on."""
    if not getattr(solver, "locates_events", True):
        raise ValueError(
            "Events need a solution between steps in the coordinates of the step, which the local coordinates of TangentSpace "
            "and of DummyDerivatives with an explicit solver are not; use OrthogonalProjection, RadauIIA5 or BDF."
        )
