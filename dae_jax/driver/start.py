"""Wrong input is refused in a sentence, before anything is traced."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from ..compiler import quickly_compiled
from ..consistent import unsolved, violation
from ..equations.constraint_jacobian import Rank, dense_mass
from ..equations.mechanical import MechanicalODE
from ..equations.regularity import mass_is_regular, mass_message, rank_message, rank_of, redundancy
from ..solution import RESULTS
from ..systems import ConstrainedSystem, System, is_mechanism
from ..types import Args, DType, State, Time
from ..validate.states import brief, refuse_no_time, refuse_not_finite, refuse_wrong_state
from ..validate.user_functions import not_finite, time_axis_advice


ADVICE = "\n`dae_jax.consistent_state(system, t0, y0, args)` gives the nearest state that does not."


def checked(system: System, t0: Time, t1: Time, dt0: Time | None, y0: State, args: Args) -> tuple[Any, Any]:
    """`y0` and `args` as arrays, once their types and shapes are right."""
    refuse_wrong_state(system, y0)
    for leaf in jax.tree.leaves(y0):
        dtype = np.dtype(jnp.result_type(leaf))
        if dtype.kind != "f" or dtype.itemsize < 4:
            real = "; write 1.0 in place of 1" if dtype.kind in "iub" else ""
            raise ValueError(f"`y0` must hold floating-point numbers, float32 or float64, but has {dtype}{real}.")
    refuse_not_finite("y0", y0)
    for name, value in (("t0", t0), ("t1", t1), ("dt0", dt0)):
        if value is not None or name != "dt0":
            refuse_no_time(name, value)
    if dt0 is not None and not any(isinstance(x, Tracer) for x in (t0, t1, dt0)):
        # In `jit`, what JAX makes of arrays that are known is not.
        start, end, step = map(np.asarray, (t0, t1, dt0))
        if step == 0:
            raise ValueError(
                "`dt0` must be a step, or None for steps that are chosen, but is 0: the order is t0, t1, dt0, y0."
            )
        if (end - start) * step < 0:
            raise ValueError(f"`dt0` = {dt0} points away from `t1` = {t1}: it must have the sign of t1 − t0.")
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    _refuse_times_of_one_number(t0, t1, dtype)
    y0 = jax.tree.map(lambda x: as_array(x, dtype), tuple(y0) if len(system.parts) > 1 else y0)
    return y0, jax.tree.map(lambda x: np.asarray(x, jnp.result_type(x)) if isinstance(x, float) else x, args)


def _refuse_times_of_one_number(t0: Time, t1: Time, dtype: DType) -> None:
    """Refuses an interval that has no length in the numbers of the state."""
    if any(isinstance(x, Tracer) for x in (t0, t1)) or np.asarray(t0) == np.asarray(t1):
        return
    if np.asarray(t0, dtype) == np.asarray(t1, dtype):
        raise ValueError(
            f"`t0` = {t0} and `t1` = {t1} are one number in {np.dtype(dtype)}, which `y0` is in: measure time from another origin, or "
            "use float64."
        )


def as_array(x: ArrayLike, dtype: DType) -> Any:
    """`x` as an array; numbers stay numpy's, which costs less than the way to a device and back."""
    if isinstance(x, jax.Array):
        return x if x.dtype == dtype else x.astype(dtype)
    return np.asarray(x, dtype)


def refuse_bad_times(saveat: diffrax.SaveAt, t0: Time, t1: Time) -> None:
    """Times to save at that are known must lie in the interval, in the order in which they are passed."""
    for sub in saved_parts(saveat):
        if sub.ts is not None and not any(isinstance(x, Tracer) for x in (sub.ts, t0, t1)):
            ts = np.asarray(sub.ts)
            start, end = np.asarray(t0), np.asarray(t1)
            low, high = min(start, end), max(start, end)
            if ts.ndim != 1 or not np.all(np.isfinite(ts)):
                raise ValueError(f"`saveat.ts` must be a vector of finite times, but is {brief(sub.ts)}.")
            if ts.size and (ts.min() < low or ts.max() > high):
                raise ValueError(
                    f"`saveat.ts` must lie between t0 = {t0} and t1 = {t1}, but spans {ts.min()} to {ts.max()}."
                )
            steps = np.diff(ts) * (1 if end >= start else -1)
            if np.any(steps < 0):
                raise ValueError("`saveat.ts` must be in the order in which the solve passes them.")


def refuse_bad_start(system: System, t0: Time, y0: State, args: Args, invertible: bool) -> Rank | None:
    """Refuses an inconsistent or singular start in words; the rank of the constraints if some are redundant. `invertible`:
    whether the mass matrix must be.
    """
    if not is_mechanism(system):
        left = _look_at_residual(system, t0, y0, args)
        if not bool(left.consistent()):
            raise ValueError(left.message() + _advice(system, t0, y0, args))
        if bool(left.several):
            raise ValueError(RESULTS[RESULTS.ambiguous_start])
        return None
    ode, mass, regular, found, redundant = _look(system, t0, y0, args, invertible)
    if not bool(regular):
        raise ValueError(mass_message(np.asarray(dense_mass(mass)), invertible))
    if not bool(found.consistent()):
        raise ValueError(found.message() + _advice(system, t0, y0, args))
    message = rank_message(ode, redundant, system.rank)
    if message:
        raise ValueError(message)
    return rank_of(ode, redundant)


def _advice(system: System, t0: Time, y0: State, args: Args) -> str:
    """What to do about a start that violates its equations."""
    reason = not_finite(system, t0, y0, args) or time_axis_advice(system, t0, y0, args)
    return f"\n{reason}" if reason else ADVICE


@quickly_compiled
def _look(system: ConstrainedSystem, t: Time, y0: State, args: Args, invertible: bool) -> Any:
    ode = MechanicalODE.of(system, t, y0, args)
    y = ode.encode(y0)
    mass, regular = ode.unchecked_mass(y[0]), mass_is_regular(ode, y[0], invertible)
    return ode, mass, regular, violation(ode, t, y), redundancy(ode, t, y)


@quickly_compiled
def _look_at_residual(system: System, t: Time, y0: State, args: Args) -> Any:
    return unsolved(system, t, y0, args)


def saved_parts(saveat: diffrax.SaveAt) -> list[Any]:
    """The `SubSaveAt`s of a `SaveAt`."""
    return [s for s in jax.tree.leaves(saveat.subs, is_leaf=is_saved_part) if is_saved_part(s)]


def is_saved_part(x: object) -> bool:
    """For `jax.tree.map`."""
    return isinstance(x, diffrax.SubSaveAt)
