"""What a solution does with its constraints, its energy and its multipliers.

Each is an array over `sol.ts`. At times that are padding, of a solve that ended early or saved its steps, it has its last
value: largest, smallest and final values are then those of the saved times. A batch of solutions has a leading axis more.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .compiler import at_ease
from .equations.constraint_jacobian import Rank, dense_mass
from .equations.mechanical import MechanicalODE
from .equations.regularity import mass_is_regular, mass_message, rank_message, redundancy
from .equations.residual_drift import EquationDrift, equation_drift
from .equations.residual_form import bordered_multipliers
from .solution import DAESolution, at_saved_times, saved_arrays
from .systems import ConstrainedSystem, ImplicitDAE, SemiExplicitDAE, System, is_mechanism
from .types import Args, Phase, State, Time
from .validate.captured import current
from .validate.states import as_floats, brief, refuse_wrong_state, refuse_wrong_system
from .validate.user_functions import refuse_no_real_number, refuse_wrong_functions, returned


HERE = "at this point"


class Drift(NamedTuple):
    """The largest violation at each saved time: `position` is max |g|, `velocity` max |(ġ, h)|."""

    position: Float[Array, " times"]
    velocity: Float[Array, " times"]

    @property
    def levels(self) -> tuple[Float[Array, " times"], ...]:
        """Both, level by level, as `EquationDrift` has them."""
        return tuple(self)


@overload
def drift(system: ConstrainedSystem, sol: DAESolution) -> Drift: ...


@overload
def drift(system: SemiExplicitDAE | ImplicitDAE, sol: DAESolution) -> EquationDrift: ...


@at_ease
def drift(system: System, sol: DAESolution) -> Drift | EquationDrift:
    """How far each saved state is off the constraints, and off the hidden ones.

    Of a `ConstrainedSystem`, a `Drift`. Of other systems an `EquationDrift`: `levels[0]` is the largest of |F| at each saved
    time, for the ẏ with which F(t, y, ẏ) = 0 holds best, so of algebraic equations what they are off by; `levels[k]` the
    largest of the k-th derivatives of F that restrict y, the hidden constraints. Beyond the last saved time, where `sol.ts` is
    infinite, it is what it was there, as are `energy` and `multipliers`.

    Errors: `ValueError` for a solution without saved states.
    """
    refuse_wrong_system(system)
    system = current(system)
    if not is_mechanism(system):
        return EquationDrift(_at_saved_times(system, sol, equation_drift))
    return Drift(*_at_saved_times(system, sol, _largest))


@at_ease
def energy(system: ConstrainedSystem, sol: DAESolution) -> Float[Array, " times"]:
    """½ vᵀM v + V(q) at each saved time.

    Errors: `ValueError` where the system has no `potential`.
    """
    if getattr(system, "potential", None) is None:
        raise ValueError("The energy needs `ConstrainedSystem(..., potential=lambda q, args: ...)`.")
    system = current(system)
    return _at_saved_times(system, sol, _energy)


@overload
def multipliers(system: ConstrainedSystem, sol: DAESolution, /) -> Float[Array, "times mp"]: ...


@overload
def multipliers(
    system: ConstrainedSystem, t: Time, q: State, v: State, args: Args = None, /
) -> Float[Array, " mp"]: ...


@at_ease
def multipliers(system: ConstrainedSystem, *at: Any) -> Any:
    """λ, one entry a constraint, and μ, one a nonholonomic one, behind each other in one vector: the constraint forces are
    −Gᵀλ − Hᵀμ. Of least norm where constraints are redundant.

    `multipliers(system, sol)` gives them at each saved time, a row each; `multipliers(system, t, q, v, args)` at a point: any JAX
    function, so that the condition of an event can use it; it costs one evaluation of the accelerations. Where constraints
    are redundant, the point form needs `ConstrainedSystem(..., rank=...)`.

    Errors: `ValueError` for a system that is no `ConstrainedSystem`: there, multipliers are among the unknowns; and where a
    point that is concrete has none.
    """
    refuse_wrong_system(system)
    system = current(system)
    if not is_mechanism(system):
        raise ValueError(
            f"`multipliers` takes a ConstrainedSystem; those of this {type(system).__name__} are among its unknowns, in `sol.ys`."
        )
    if len(at) == 1:
        (sol,) = at
        of = lambda find: _at_saved_times(system, sol, functools.partial(_by_ode, find, rank=sol.rank))
        return _or_else(of(MechanicalODE.multipliers), lambda: of(_without_inverse))
    if len(at) not in (3, 4):
        raise TypeError("`multipliers` takes (system, sol) or (system, t, q, v, args).")
    t, q, v, *args = current(at)
    state = as_floats((q, v))
    refuse_wrong_state(system, state)
    ode = MechanicalODE.of(system, t, state, args[0] if args else None)
    y = ode.encode(state)
    if not any(isinstance(x, Tracer) for x in jax.tree.leaves((ode, t, y))):
        _refuse_masses_and_rank(ode, t, y)
    found = _or_else(ode.multipliers(t, y), lambda: _without_inverse(ode, t, y))
    if not isinstance(found, Tracer) and bool(jnp.any(jnp.isnan(found))):
        raise ValueError(
            "`multipliers` finds none at this point: the force or a constraint is not a number, or the constraints depend on each "
            "other there; where they are redundant say how many are independent by `ConstrainedSystem(..., rank=...)`."
        )
    return found


def _largest(system: ConstrainedSystem, t: Time, y: State, args: Args) -> tuple[Any, Any]:
    ode = MechanicalODE.of(system, t, y, args)
    g, dg = ode.invariants(t, ode.encode(y))
    return jnp.max(jnp.abs(g), initial=0), jnp.max(jnp.abs(dg), initial=0)


def _energy(system: ConstrainedSystem, t: Time, y: State, args: Args) -> Any:
    potential: Any = system.potential
    call = "potential(q, args)"
    refuse_no_real_number(returned(call, potential, y[0], args), call)
    ode = MechanicalODE.of(system, t, y, args)
    flat_q, flat_v = ode.encode(y)
    mass = dense_mass(ode.mass(flat_q))
    momentum = flat_v if mass is None else mass * flat_v if mass.ndim < 2 else jnp.dot(mass, flat_v)
    return jnp.dot(flat_v, momentum) / 2 + potential(y[0], args)


def _by_ode(
    find: Callable[..., Any], system: ConstrainedSystem, t: Time, y: State, args: Args, rank: int | Rank | None
) -> Float[Array, " mp"]:
    ode = MechanicalODE.of(system, t, y, args, rank)
    return find(ode, t, ode.encode(y))


def _without_inverse(ode: MechanicalODE, t: Time, y: Phase) -> Float[Array, " mp"]:
    """Those of a mechanism with massless coordinates; NaN where constraints are redundant."""
    q, v = y
    if ode.rank is not None:
        return jnp.full(ode.holonomic + ode.nonholonomic, jnp.nan, q.dtype)
    a, mass = ode.constraint_jacobian(t, q, v), dense_mass(ode.mass(q))
    return bordered_multipliers(ode, t, (q, v), a, mass, jnp.ones(len(a), q.dtype))


def _or_else(found: Array, other: Callable[[], Array]) -> Array:
    """The numbers found, and others where they are NaN and known to be."""
    if isinstance(found, Tracer) or not bool(jnp.any(jnp.isnan(found))):
        return found
    return jnp.where(jnp.isnan(found), other(), found)


def _refuse_masses_and_rank(ode: MechanicalODE, t: Time, y: Phase) -> None:
    message, given = None, ode.system.rank
    if not bool(mass_is_regular(ode, y[0], False)):
        message = mass_message(np.asarray(dense_mass(ode.unchecked_mass(y[0]))), False, HERE)
    elif given is not None:
        message = rank_message(ode, redundancy(ode, t, y), given, HERE)
    if message:
        raise ValueError(message)


def _at_saved_times(system: System, sol: DAESolution, of: Callable[..., Any]) -> Any:
    """of(system, t, y, args) at each saved time."""
    if not isinstance(sol, DAESolution):
        raise TypeError(f"`sol` must be what `daesolve` returns, but is {brief(sol)}.")
    if not isinstance(sol.ts, jax.Array | np.ndarray):
        raise ValueError(
            "`sol` must have saved states: `SaveAt(t1=True)` or `SaveAt(ts=...)`, without `subs`. Of a solution with several "
            "parts take one, `dataclasses.replace(sol, ts=sol.ts[0], ys=sol.ys[0])`."
        )

    def along(ts: Float[Array, "*batch times"], ys: State, args: Args, changed: Args) -> Any:
        if ts.ndim > 1:
            return eqx.filter_vmap(along)(ts, ys, args, changed)
        _refuse_no_states(system, ts, ys, args)
        return at_saved_times(current(of), system, ts, ys, args, changed)

    return along(*saved_arrays(sol))


def _refuse_no_states(system: System, ts: Float[Array, "*batch times"], ys: State, args: Args) -> None:
    one = jax.tree.map(lambda y: jax.ShapeDtypeStruct(y.shape[1:], y.dtype), ys)
    try:
        refuse_wrong_state(system, one, "sol.ys")
        refuse_wrong_functions(system, ts[0], one, args)
    except (TypeError, ValueError) as refusal:
        raise ValueError(
            "`sol.ys` must hold states of `system`: leave out `SaveAt(fn=...)`, and take the system that was solved.\n"
            f"({refusal})"
        ) from refusal
