"""`daesolve`: one solve of a DAE, through `diffrax.diffeqsolve`."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .constraints import MechanicalODE
from .formulations import AbstractFormulation, Differentiation, StateSpace
from .initialise import violation
from .kernels import one_kernel
from .solution import RESULTS, DAESolution, Interpolation, all_finite
from .solvers import DOP853, RATTLE, AbstractManifoldSolver, OrthogonalProjection, TangentSpace, unrolled
from .solvers.tangent_space import TangentPoint
from .systems import ConstrainedSystem


def daesolve(
    system: ConstrainedSystem,
    solver: diffrax.AbstractSolver,
    t0: Any,
    t1: Any,
    dt0: Any,
    y0: Any,
    args: Any = None,
    *,
    formulation: AbstractFormulation | None = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),  # noqa: B008
    event: diffrax.Event | None = None,
    max_steps: int | None = 4096,
    throw: bool = True,
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),  # noqa: B008
) -> DAESolution:
    """Solves a differential-algebraic equation. Mirrors `diffrax.diffeqsolve`.

    **Arguments**

    - `system`: the equations.
    - `solver`: any diffrax solver, or one that keeps its steps on the constraints (`OrthogonalProjection`,
      `SymmetricProjection`, `TangentSpace`, `RATTLE`).
    - `t0`, `t1`, `dt0`: start, end and first (or fixed) step; t1 < t0 integrates backwards, with dt0 < 0.
    - `y0`: the state (q, v) at `t0`; must satisfy the constraints and their first derivative.
    - `args`: handed to the system's functions.
    - `formulation`: which equations are integrated; by default `Differentiation()`.
    - `stepsize_controller`: by default fixed steps if `dt0` is given, else `PIDController(rtol=1e-8, atol=1e-8)` (1e-5 in
      float32).
    - `saveat`, `adjoint`, `event`, `max_steps`, `throw`, `progress_meter`: as in diffrax. Functions in `saveat` and
      `event` get the state in the structure of `y0`, and the user's `args`. Forward-mode derivatives need
      `adjoint=diffrax.ForwardMode()`.

    **Returns** a `DAESolution`.

    Errors: `ValueError` or `TypeError` in a sentence for wrong input that is concrete; `RuntimeError` where the solve
    fails, or a `RESULTS` code with `throw=False`.
    """
    y0, args = _checked(system, t0, t1, dt0, y0, args)
    formulation = Differentiation() if formulation is None else formulation
    _fits(formulation, solver)
    if isinstance(solver, RATTLE):
        _fits_rattle(system, formulation, t0, y0, args)
    dtype = jnp.result_type(*jax.tree.leaves(y0))
    if stepsize_controller is None:
        stepsize_controller = _default_controller(solver, dt0, dtype)
    t0, t1, dt0 = (x if x is None else _as_array(x, dtype) for x in (t0, t1, dt0))
    saveat = jax.tree.map(lambda x: _as_array(x, dtype) if isinstance(x, np.ndarray | jax.Array) else x, saveat)
    solve = _Solve(formulation, solver, saveat, stepsize_controller, adjoint, event, max_steps, progress_meter)
    program, arrays = _split((solve, system, t0, t1, dt0, y0, args))
    if any(isinstance(x, jax.core.Tracer) for x in arrays):
        sol, _ = _run(program, system.rank, arrays)
    else:
        _refuse_bad_times(saveat, t0, t1)
        if program not in _ranks:
            _ranks[program] = _refuse_bad_start(system, t0, y0, args)
        sol, start = _run(program, _ranks[program], arrays)
        if not start.as_expected(sol.rank):
            _ranks[program] = _refuse_bad_start(system, t0, y0, args)
            sol, _ = _run(program, _ranks[program], arrays)
    return _raise_if_failed(sol) if throw else sol


# One compiled program a system and method. `equinox.filter_jit` would do, at three times the cost of a call.


class _Program(NamedTuple):
    """All of a solve but its arrays: hashable, and different for 1 and 1.0."""

    treedef: Any
    leaves: tuple[Any, ...]
    types: tuple[type, ...]

    def inputs(self, arrays: list[Any]) -> Any:
        """The inputs with these arrays."""
        rest = iter(arrays)
        return jax.tree.unflatten(self.treedef, [next(rest) if x is _ARRAY else x for x in self.leaves])


_ARRAY = object()
_ranks: dict[_Program, int | None] = {}


def _split(inputs: Any) -> tuple[_Program, list[Any]]:
    leaves, treedef = jax.tree.flatten(inputs)
    arrays = [x for x in leaves if isinstance(x, jax.Array | np.ndarray | np.generic)]
    static = tuple(_ARRAY if isinstance(x, jax.Array | np.ndarray | np.generic) else x for x in leaves)
    return _Program(treedef, static, tuple(map(type, static))), arrays


class _Static(eqx.Module):
    """What a jitted function returns that is not an array."""

    value: Any = eqx.field(static=True)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _jitted(program: _Program, rank: int | None, arrays: list[Any]) -> Any:
    solve, *inputs = program.inputs(jax.tree.map(jnp.asarray, arrays))
    (sol, start) = solve(*inputs, rank)
    numbers, rest = eqx.partition(sol, eqx.is_array)
    return numbers, _Static(rest), start


def _run(program: _Program, rank: int | None, arrays: list[Any]) -> tuple[DAESolution, "_Start"]:
    numbers, rest, start = _jitted(program, rank, arrays)
    return eqx.combine(numbers, rest.value), start


class _Start(eqx.Module):
    """What a solve saw of its initial state: whether it is consistent, and how many constraints are independent."""

    consistent: Any
    rank: Any
    constraints: int = eqx.field(static=True)

    def as_expected(self, rank: int | None) -> bool:
        """Whether it is consistent, with the rank that was counted on."""
        return bool(self.consistent) and int(self.rank) == (self.constraints if rank is None else rank)


# Wrong input is refused before anything is traced


def _checked(system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any) -> tuple[Any, Any]:
    """`y0` and `args` as arrays, once their types and shapes are right."""
    if not isinstance(system, ConstrainedSystem):
        raise TypeError(f"`system` must be a dae_jax.ConstrainedSystem, but is a {type(system).__name__}.")
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
    as_array = lambda x: np.asarray(x, jnp.result_type(x)) if isinstance(x, float) else x
    return jax.tree.map(lambda x: _as_array(x, dtype), tuple(y0)), jax.tree.map(as_array, args)


def _as_array(x: Any, dtype: Any) -> Any:
    """`x` as an array; numbers stay numpy's, which costs less than the way to a device and back."""
    if isinstance(x, jax.Array):
        return x if x.dtype == dtype else x.astype(dtype)
    return np.asarray(x, dtype)


def _brief(x: Any) -> str:
    text = repr(x)
    return text if len(text) < 200 else text[:200] + "…"


def _fits(formulation: Any, solver: Any) -> None:
    """Refuses pairs of formulation and solver that make no sense, and shapes that do not fit."""
    if not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"`solver` must be a diffrax solver such as diffrax.Tsit5(), but is {_brief(solver)}.")
    if not isinstance(formulation, AbstractFormulation):
        raise TypeError(
            f"`formulation` must be a formulation such as dae_jax.Baumgarte(...), but is {_brief(formulation)}."
        )
    if isinstance(formulation, StateSpace) and isinstance(solver, AbstractManifoldSolver):
        raise ValueError(
            f"StateSpace has no constraints left for {type(solver).__name__} to keep: in its chart they hold by "
            "construction. Use the inner solver itself."
        )


def _fits_rattle(system: ConstrainedSystem, formulation: Any, t0: Any, y0: Any, args: Any) -> None:
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


def _default_controller(solver: Any, dt0: Any, dtype: Any) -> Any:
    if dt0 is not None:
        return diffrax.ConstantStepSize()
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(f"`dt0` must be given: {type(solver).__name__} takes fixed steps.")
    return _PID64 if dtype == jnp.float64 else _PID32


_PID64, _PID32 = (diffrax.PIDController(rtol=tolerance, atol=tolerance) for tolerance in (1e-8, 1e-5))


def _refuse_bad_times(saveat: Any, t0: Any, t1: Any) -> None:
    for sub in _subs(saveat):
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


def _refuse_bad_start(system: Any, t0: Any, y0: Any, args: Any) -> int | None:
    """Refuses an inconsistent start in words; the rank of the constraints if some are redundant."""
    found = _look(system, t0, y0, args)
    if not bool(found.consistent()):
        raise ValueError(
            found.message()
            + "\n`dae_jax.consistent_state(system, t0, y0, args)` gives the nearest state that does not."
        )
    count = found.residuals[1].shape[0]
    if system.rank is not None:
        return system.rank
    rank = int(found.rank)
    if rank < count and float(found.contradiction) > 1e-6:
        raise ValueError(
            f"Only {rank} of the {count} constraints are independent at the start, and the others contradict them: no "
            "acceleration satisfies all. Remove the redundant constraints or make them agree."
        )
    return rank if rank < count else None


@eqx.filter_jit
def _look(system: Any, t: Any, y0: Any, args: Any) -> Any:
    ode = MechanicalODE.of(system, t, y0, args)
    return violation(ode, t, ode.encode(y0))


def _subs(saveat: Any) -> list[Any]:
    return [s for s in jax.tree.leaves(saveat.subs, is_leaf=_is_sub) if _is_sub(s)]


def _is_sub(x: Any) -> bool:
    return isinstance(x, diffrax.SubSaveAt)


# The solve


class _Decode(eqx.Module):
    """The user's view of a point of the solver's dense output."""

    formulation: AbstractFormulation
    solver: diffrax.AbstractSolver

    def __call__(self, t: Any, y: Any, ode: Any) -> Any:
        if isinstance(self.solver, AbstractManifoldSolver):
            y = self.solver.land(t, y, ode)
        return self.formulation.decode(t, y, ode)


class _Solve(eqx.Module):
    """All that is fixed about a solve, as one callable for `jit`."""

    formulation: AbstractFormulation
    solver: diffrax.AbstractSolver
    saveat: diffrax.SaveAt
    controller: diffrax.AbstractStepSizeController
    adjoint: diffrax.AbstractAdjoint
    event: diffrax.Event | None
    max_steps: int | None = eqx.field(static=True)
    progress_meter: diffrax.AbstractProgressMeter

    def __call__(
        self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | None
    ) -> tuple[DAESolution, _Start]:
        inputs = (self, system, t0, t1, dt0, y0, args)
        arrays, static = eqx.partition(inputs, eqx.is_array)
        outline: list[Any] = []

        def numbers(arrays: Any) -> Any:
            solve, *rest = eqx.combine(arrays, static)
            out, fixed = eqx.partition(solve._diffeqsolve(*rest, rank), eqx.is_array)
            outline[:] = [fixed]
            return out

        out = one_kernel(numbers, self._derivative())(arrays)
        ode = MechanicalODE.of(system, t0, y0, args, rank)
        found = violation(ode, t0, ode.encode(y0))
        sol = self._solution(eqx.combine(out, outline[0]), args, rank, found.consistent())
        return sol, _Start(found.consistent(), found.rank, found.residuals[1].shape[0])

    def _derivative(self) -> Any:
        """In which mode the adjoint allows derivatives; a progress meter needs callbacks."""
        if not isinstance(self.progress_meter, diffrax.NoProgressMeter):
            return "any"
        if isinstance(self.adjoint, diffrax.ForwardMode):
            return "forward"
        return "reverse" if isinstance(self.adjoint, diffrax.RecursiveCheckpointAdjoint) else "any"

    def _diffeqsolve(self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | None) -> Any:
        y, ode = self.formulation.encode(system, t0, y0, args, rank)
        decode = _Decode(self.formulation, self.solver)
        between = self.saveat.dense or any(sub.ts is not None for sub in _subs(self.saveat)) or self.event is not None

        def saved(sub: Any) -> Any:
            fn = sub.fn
            view = lambda t, y, ode: fn(t, decode(t, y, ode), args)
            return eqx.tree_at(lambda s: s.fn, sub, view) if _is_sub(sub) else sub

        saveat = eqx.tree_at(
            lambda s: s.subs,
            self.saveat,
            jax.tree.map(saved, self.saveat.subs, is_leaf=_is_sub),
            is_leaf=lambda x: x is None,
        )
        event = self.event and dataclasses.replace(
            self.event,
            cond_fn=jax.tree.map(lambda c: _on_states(c, decode, args), self.event.cond_fn, is_leaf=callable),
        )
        sol = diffrax.diffeqsolve(
            self.formulation.term(),
            _economical(self.solver, between),
            t0, t1, dt0, y,
            args=ode, saveat=saveat, stepsize_controller=_floored(self.controller, t0, t1), adjoint=self.adjoint, event=event,
            max_steps=self.max_steps, throw=False, progress_meter=self.progress_meter,
        )  # fmt: skip
        interpolation = None
        if sol.interpolation is not None:
            interpolation = Interpolation(_uniform(self.solver, sol.interpolation), decode, ode)
        return sol.t0, sol.t1, sol.ts, sol.ys, interpolation, sol.stats, sol.result, sol.event_mask

    def _solution(self, out: Any, args: Any, rank: int | None, consistent: Any) -> DAESolution:
        *fields, result, event_mask = out
        code = RESULTS.promote(result)
        _, _, ts, ys, *_ = fields
        failed = lambda name, instead, when=True: RESULTS.where((code == name) & when, instead, code)
        code = failed(RESULTS.dt_min_reached, RESULTS.step_rejected)
        code = failed(RESULTS.nonlinear_divergence, RESULTS.off_manifold)
        if ts is not None:
            finite = [all_finite(*pair) for pair in _saved(self.saveat, ts, ys)]
            code = failed(RESULTS.successful, RESULTS.not_finite, ~jnp.all(jnp.stack(finite))) if finite else code
        code = RESULTS.where(consistent, code, RESULTS.inconsistent_start)
        return DAESolution(*fields, code, event_mask, args, rank)


def _saved(saveat: Any, ts: Any, ys: Any) -> list[tuple[Any, Any]]:
    """The (times, states) of each part of `saveat`."""
    structure = jax.tree.structure(saveat.subs, is_leaf=_is_sub)
    return [
        (t, y) for t, y in zip(structure.flatten_up_to(ts), structure.flatten_up_to(ys), strict=True) if t is not None
    ]


def _floored(controller: Any, t0: Any, t1: Any) -> Any:
    """The controller with a smallest step at the resolution of time, below which a solve cannot get on."""
    if type(controller) is not diffrax.PIDController or controller.dtmin is not None:
        return controller
    floor = 16 * jnp.finfo(jnp.result_type(t0)).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    return dataclasses.replace(controller, dtmin=floor, force_dtmin=False)


def _uniform(solver: Any, path: diffrax.DenseInterpolation) -> diffrax.DenseInterpolation:
    """The dense output with one type of point, also for an interval of length 0."""
    if not isinstance(solver, TangentSpace):
        return path
    first = TangentPoint(path.y0_if_trivial, jax.tree.map(lambda x: x[0], path.infos["normals"]))
    return eqx.tree_at(lambda p: p.y0_if_trivial, path, first)


def _on_states(cond: Callable[..., Any], decode: Any, args: Any) -> Callable[..., Any]:
    user_args = args

    def condition(t: Any, y: Any, args: Any, **kwargs: Any) -> Any:
        return cond(t, decode(t, y, args), user_args, **kwargs)

    return condition


def _economical(solver: Any, between: bool) -> Any:
    """The solver without what this solve does not need, with its stages written out."""
    if isinstance(solver, OrthogonalProjection | TangentSpace):
        return dataclasses.replace(solver, solver=_economical(solver.solver, between))
    if isinstance(solver, DOP853):
        return dataclasses.replace(solver, dense=between)
    return unrolled(solver)


_OKAY = {int(code._value) for code in (RESULTS.successful, RESULTS.event_occurred)}


def _raise_if_failed(sol: DAESolution) -> DAESolution:
    if isinstance(sol.result._value, jax.core.Tracer):
        okay = (sol.result == RESULTS.successful) | (sol.result == RESULTS.event_occurred)
        return sol.result.error_if(sol, ~okay)
    if int(sol.result._value) in _OKAY:
        return sol
    reached = [np.asarray(t)[np.isfinite(t)] for t in jax.tree.leaves(sol.ts)]
    last = [t[-1] for t in reached if t.size]
    where = f" (last saved time: t = {last[-1]:.6g})" if last else ""
    raise RuntimeError(f"{RESULTS[sol.result]}{where} {sol.stats['num_steps']} steps were taken.")
