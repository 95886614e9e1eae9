"""Wrong input is refused in a sentence, before anything is traced."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .constraints import MechanicalODE
from .formulations import AbstractFormulation, Differentiation, DummyDerivatives, Residual, StateSpace
from .initialise import unsolved, violation
from .normals import Rank
from .regularity import mass_is_regular, mass_message, rank_message, rank_of, redundancy
from .solvers import RATTLE, AbstractManifoldSolver, AbstractResidualSolver, TangentSpace, unrolled
from .systems import ConstrainedSystem, ImplicitDAE, SemiExplicitDAE


ADVICE = "\n`dae_jax.consistent_state(system, t0, y0, args)` gives the nearest state that does not."


def checked(system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any) -> tuple[Any, Any]:
    """`y0` and `args` as arrays, once their types and shapes are right."""
    if isinstance(system, ConstrainedSystem):
        _check_positions_and_velocities(y0)
    elif isinstance(system, SemiExplicitDAE):
        if not isinstance(y0, tuple | list) or len(y0) != 2:
            raise ValueError(f"`y0` must be the pair (x, z) of a SemiExplicitDAE, but is {_brief(y0)}.")
    elif not isinstance(system, ImplicitDAE):
        raise TypeError(
            "`system` must be a dae_jax.ConstrainedSystem, SemiExplicitDAE or ImplicitDAE, but is a "
            f"{type(system).__name__}."
        )
    for leaf in jax.tree.leaves(y0):
        dtype = jnp.result_type(leaf)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise ValueError(f"`y0` must hold floating-point numbers, but has {dtype}; write 1.0 in place of 1.")
        if not isinstance(leaf, jax.core.Tracer) and not np.all(np.isfinite(np.asarray(leaf))):
            raise ValueError(f"`y0` must be finite, but has NaN or infinity: {_brief(leaf)}.")
    for name, value in (("t0", t0), ("t1", t1), ("dt0", dt0)):
        if value is None and name == "dt0":
            continue
        if jnp.shape(value) != () or jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
            raise ValueError(f"`{name}` must be a real number, but is {_brief(value)}.")
        if not isinstance(value, jax.core.Tracer) and not np.isfinite(value):
            raise ValueError(f"`{name}` must be finite, but is {value}.")
    if dt0 is not None and not any(isinstance(x, jax.core.Tracer) for x in (t0, t1, dt0)) and (t1 - t0) * dt0 < 0:
        raise ValueError(f"`dt0` = {dt0} points away from `t1` = {t1}: it must have the sign of t1 − t0.")
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    y0 = jax.tree.map(lambda x: as_array(x, dtype), y0 if isinstance(system, ImplicitDAE) else tuple(y0))
    return y0, jax.tree.map(lambda x: np.asarray(x, jnp.result_type(x)) if isinstance(x, float) else x, args)


def _check_positions_and_velocities(y0: Any) -> None:
    if not isinstance(y0, tuple | list) or len(y0) != 2:
        raise ValueError(f"`y0` must be the pair (q, v) of positions and velocities, but is {_brief(y0)}.")
    q, v = y0
    if jax.tree.structure(q) != jax.tree.structure(v):
        raise ValueError("`y0` = (q, v): q and v must have the same structure.")
    for a, b in zip(jax.tree.leaves(q), jax.tree.leaves(v), strict=True):
        if np.shape(a) != np.shape(b):
            raise ValueError(
                f"`y0` = (q, v): q and v must have the same shape, but have {np.shape(a)} and {np.shape(b)}."
            )


def as_array(x: Any, dtype: Any) -> Any:
    """`x` as an array; numbers stay numpy's, which costs less than the way to a device and back."""
    if isinstance(x, jax.Array):
        return x if x.dtype == dtype else x.astype(dtype)
    return np.asarray(x, dtype)


def _brief(x: Any) -> str:
    text = repr(x)
    return text if len(text) < 200 else text[:200] + "…"


def refuse_misfits(system: Any, formulation: Any, solver: Any, t0: Any, y0: Any, args: Any) -> None:
    """Refuses pairs of formulation and solver that make no sense, and shapes that do not fit."""
    if not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"`solver` must be a diffrax solver such as diffrax.Tsit5(), but is {_brief(solver)}.")
    if not isinstance(formulation, AbstractFormulation):
        raise TypeError(
            f"`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is {_brief(formulation)}."
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
            f"{_brief(solver)}."
        )
    if isinstance(formulation, StateSpace) and not isinstance(system, ConstrainedSystem):
        raise ValueError("StateSpace takes a ConstrainedSystem: its chart gives the positions of a mechanism.")
    if isinstance(formulation, StateSpace) and isinstance(solver, AbstractManifoldSolver):
        raise ValueError(
            f"StateSpace has no constraints left for {type(solver).__name__} to keep: in its chart they hold by "
            "construction. Use the inner solver itself."
        )
    if isinstance(solver, RATTLE):
        _fits_rattle(system, formulation, t0, y0, args)


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


def refuse_bad_times(saveat: Any, t0: Any, t1: Any) -> None:
    """Times to save at must lie in the interval, in the order in which they are passed."""
    for sub in saved_parts(saveat):
        if sub.ts is not None:
            ts = np.asarray(sub.ts)
            low, high = min(t0, t1), max(t0, t1)
            if ts.size and (ts.min() < low or ts.max() > high):
                raise ValueError(
                    f"`saveat.ts` must lie between t0 = {t0} and t1 = {t1}, but spans {ts.min()} to {ts.max()}."
                )
            steps = np.diff(ts) * (1 if t1 >= t0 else -1)
            if np.any(steps < 0):
                raise ValueError("`saveat.ts` must be in the order in which the solve passes them.")


def takes_residuals(solver: Any) -> bool:
    """Whether a solver works on 0 = F(t, y, ẏ) in place of an ODE."""
    return isinstance(solver, AbstractResidualSolver)


def refuse_bad_start(system: Any, t0: Any, y0: Any, args: Any, invertible: bool) -> Rank | None:
    """Refuses an inconsistent or singular start in words; the rank of the constraints if some are redundant. `invertible`:
    whether the mass matrix must be.
    """
    if not isinstance(system, ConstrainedSystem):
        left = _look_at_residual(system, t0, y0, args)
        if not bool(left.consistent()):
            raise ValueError(left.message() + ADVICE)
        return None
    ode, mass, regular, found, redundant = _look(system, t0, y0, args, invertible)
    if not bool(regular):
        raise ValueError(mass_message(np.asarray(mass), invertible))
    if not bool(found.consistent()):
        raise ValueError(found.message() + ADVICE)
    message = rank_message(ode, redundant, system.rank)
    if message:
        raise ValueError(message)
    return rank_of(ode, redundant)


@eqx.filter_jit
def _look(system: Any, t: Any, y0: Any, args: Any, invertible: bool) -> Any:
    ode = MechanicalODE.of(system, t, y0, args)
    y = ode.encode(y0)
    mass, regular = ode.unchecked_mass(y[0]), mass_is_regular(ode, y[0], invertible)
    return ode, mass, regular, violation(ode, t, y), redundancy(ode, t, y)


@eqx.filter_jit
def _look_at_residual(system: Any, t: Any, y0: Any, args: Any) -> Any:
    return unsolved(system, t, y0, args)


def saved_parts(saveat: Any) -> list[Any]:
    """The `SubSaveAt`s of a `SaveAt`."""
    return [s for s in jax.tree.leaves(saveat.subs, is_leaf=is_saved_part) if is_saved_part(s)]


def is_saved_part(x: Any) -> bool:
    """For `jax.tree.map`."""
    return isinstance(x, diffrax.SubSaveAt)
