"""A solve as a compiled program: what is traced once for a system and a method, and run on numbers."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from .checks import is_saved_part, saved_parts
from .compiler import PullBack, inexact, one_kernel, one_kernel_enabled, waiting
from .formulations import AbstractFormulation, Residual
from .initialise import look_at_end, look_at_start
from .jumps import Jump, refuse_wrong_event, solve_with_jumps
from .linalg import rms_norm
from .normals import Rank
from .regularity import COARSE
from .solution import RESULTS, DAESolution, Interpolation, all_finite, precision_of
from .solvers import (
    BDF,
    DOP853,
    AbstractManifoldSolver,
    AbstractResidualSolver,
    OrthogonalProjection,
    RadauIIA5,
    SelectedResiduals,
    SelectedStates,
    TangentSpace,
    WithoutFailedSteps,
    first_step,
    unrolled,
)
from .solvers.tangent_space import TangentPoint
from .tape import Taped, as_it_is, can_be_taped, cotangents, recorded, saved_times
from .user_functions import refuse_wrong_functions, returned


class Program(NamedTuple):
    """All of a solve but its arrays: hashable, and different for 1 and 1.0."""

    treedef: Any
    leaves: tuple[Any, ...]
    types: tuple[type, ...]
    one_kernel: bool

    def inputs(self, arrays: list[Any]) -> Any:
        """The inputs with these arrays."""
        rest = iter(arrays)
        return jax.tree.unflatten(self.treedef, [next(rest) if x is _ARRAY else x for x in self.leaves])


_ARRAY = object()


def split(inputs: Any) -> tuple[Program, list[Any]]:
    """The inputs of a solve as a program and its arrays."""
    leaves, treedef = jax.tree.flatten(inputs)
    arrays = [x for x in leaves if isinstance(x, jax.Array | np.ndarray | np.generic)]
    static = tuple(_ARRAY if isinstance(x, jax.Array | np.ndarray | np.generic) else x for x in leaves)
    return Program(treedef, static, tuple(map(type, static)), one_kernel_enabled()), arrays


class _Split(eqx.Module):
    """What a jitted function returns: its arrays, and the rest."""

    numbers: Any
    rest: Any = eqx.field(static=True)

    @classmethod
    def of(cls, tree: Any) -> "_Split":
        return cls(*eqx.partition(tree, eqx.is_array))

    def whole(self) -> Any:
        """The two together."""
        return eqx.combine(self.numbers, self.rest)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _jitted(program: Program, rank: int | Rank | None, arrays: list[Any]) -> Any:
    solve, *inputs = program.inputs(jax.tree.map(jnp.asarray, arrays))
    waiting.begin(always=not isinstance(solve.progress_meter, diffrax.NoProgressMeter))
    solve.refuse_wrong_functions(*inputs)
    sol, as_expected = (
        (solve_with_jumps(solve, *inputs, rank)) if isinstance(solve.event, Jump) else solve(*inputs, rank)
    )
    return _Split.of(sol), as_expected


@functools.partial(jax.jit, static_argnums=(0, 1))
def _numbers(program: Program, rank: int | Rank | None, arrays: list[Any]) -> _Split:
    """diffrax's part of a solve; jitted, so that derivatives and batches of it find it traced."""
    solve, *inputs = program.inputs(arrays)
    return _Split.of(solve._diffeqsolve(*inputs, rank))


def run(program: Program, rank: int | Rank | None, arrays: list[Any]) -> tuple[DAESolution, Any, float]:
    """The solution, whether the start was consistent and of the given rank, and the seconds spent on compiling this."""
    try:
        sol, as_expected = _jitted(program, rank, arrays)
    finally:
        seconds = waiting.end()
    return sol.whole(), as_expected, seconds


class _Decode(eqx.Module):
    """The user's view of a point of the solver's dense output."""

    formulation: AbstractFormulation
    solver: diffrax.AbstractSolver

    def __call__(self, t: Any, y: Any, ode: Any) -> Any:
        if isinstance(self.solver, AbstractManifoldSolver):
            y = self.solver.land(t, y, ode)
        return self.formulation.decode(t, y, ode)


class _View(eqx.Module):
    """What is saved of a point of the solver's dense output."""

    fn: Callable[..., Any]
    decode: _Decode
    args: Any

    def __call__(self, t: Any, y: Any, ode: Any) -> Any:
        return self.fn(t, self.decode(t, y, ode), self.args)


class Solve(eqx.Module):
    """All that is fixed about a solve, as one callable for `jit`."""

    formulation: AbstractFormulation
    solver: diffrax.AbstractSolver
    saveat: diffrax.SaveAt
    controller: diffrax.AbstractStepSizeController
    adjoint: diffrax.AbstractAdjoint
    event: diffrax.Event | Jump | None
    max_steps: int | None = eqx.field(static=True)
    progress_meter: diffrax.AbstractProgressMeter

    def __call__(
        self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | Rank | None
    ) -> tuple[DAESolution, Any]:
        numbers, arrays = self.kernel(system, t0, t1, dt0, y0, args, rank)
        forward, _ = self._forwards().kernel(system, t0, t1, dt0, y0, args, rank)
        pull_back = self._pull_back(system, t0, t1, dt0, y0, args, rank)
        *fields, end = one_kernel(numbers, self.derivative(), pull_back, forward)(arrays).whole()
        check, check_arrays = self._check(system, t0, y0, args, rank, end)
        # A yes or no has no derivative.
        found = one_kernel(check, self.derivative())(jax.lax.stop_gradient(check_arrays))
        (_, as_expected), *_ = found
        return self._solution(fields, args, rank, found), as_expected

    def refuse_wrong_functions(self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any) -> None:
        """Refuses functions of the user that do not take or return what they must, in a sentence."""
        refuse_wrong_functions(system, t0, y0, args)
        refuse_wrong_event(self.event, t0, y0, args)
        for part in saved_parts(self.saveat):
            returned("saveat.fn(t, y, args)", part.fn, t0, y0, args)

    def _check(
        self, system: Any, t0: Any, y0: Any, args: Any, rank: int | Rank | None, end: Any
    ) -> tuple[Callable[..., Any], list[Any]]:
        """What is wrong with the start and the end, as a function of arrays, and its arrays."""
        manifold, residual = (isinstance(self.solver, c) for c in (AbstractManifoldSolver, AbstractResidualSolver))
        # Points between the steps of a solver of residuals are off by what its dense output is.
        keeps = self.formulation.keeps if not residual or self.event is None else (False, False)
        keeps = (True, True) if manifold else keeps
        if isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController):
            tolerances = tuple(jnp.max(jnp.asarray(getattr(self.controller, name))) for name in ("rtol", "atol"))
        else:
            tolerances = (0.0, 0.0) if residual else (COARSE, COARSE)
        program, arrays = split((system, t0, y0, args, end, tolerances, self.event))
        invertible = self.formulation.inverts_mass

        def check(arrays: Any) -> Any:
            *inputs, end, tolerances, event = program.inputs(arrays)
            start = look_at_start(*inputs, rank, invertible)
            (t, state), (*_, args) = end, inputs
            conditions = [] if event is None else jax.tree.leaves(event.cond_fn, is_leaf=callable)
            finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state)]
            defined = [~jnp.isnan(condition(t, state, args)) for condition in conditions]
            numbers = (jnp.all(jnp.stack(finite)), jnp.all(jnp.asarray(defined, bool)))
            return start, look_at_end(*inputs, rank, invertible, end, keeps, tolerances, residual), numbers

        return check, arrays

    def kernel(
        self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | Rank | None
    ) -> tuple[Callable[[list[Any]], "_Split"], list[Any]]:
        """What can become one kernel: a function of arrays, and its arrays."""
        program, arrays = split((self, system, t0, t1, dt0, y0, args))

        def numbers(arrays: list[Any]) -> _Split:
            # JAX's derivatives name the (empty) mesh, and would trace anew what was traced without a name for it.
            with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
                return _numbers(program, rank, arrays)

        return numbers, arrays

    def _pull_back(
        self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | Rank | None
    ) -> PullBack | None:
        """The reverse derivative from a tape, where it applies."""
        size = sum(leaf.size for leaf in jax.tree.leaves(y0))
        if self.derivative() != "reverse" or not can_be_taped(self, size):
            return None
        program, _ = split((self, system, t0, t1, dt0, y0, args))

        def pull_back(inputs: Any, cotangent: Any) -> list[Any]:
            (arrays,) = inputs
            solve, *rest = program.inputs(arrays)
            recording, also_arrays = dataclasses.replace(solve._forwards(), saveat=recorded(solve.saveat)).kernel(*rest, rank)
            _, _, ts, ys, *_ = recording(also_arrays).numbers
            numbers, others = eqx.partition(arrays, eqx.is_inexact_array)
            fixed: list[Any] = []

            def encoded(numbers: Any) -> Any:
                solve, *inputs = program.inputs(eqx.combine(numbers, others))
                found, fixed[:] = eqx.partition(solve._taped(*inputs, rank), eqx.is_inexact_array)
                return found

            found, through_encoding = jax.vjp(encoded, numbers)
            of_t0, of_t1, of_ts, of_ys, *_ = cotangent.numbers
            fixed_steps = isinstance(self.controller, diffrax.ConstantStepSize)
            of_taped = cotangents(eqx.combine(found, Taped(*fixed)), fixed_steps, (ts["tape"], ys["tape"]), of_ys)
            return inexact(through_encoding(saved_times(of_taped, self.saveat.subs, of_t0, of_t1, of_ts))[0])

        return pull_back

    def _taped(self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | Rank | None) -> Taped:
        y, ode = self.formulation.encode(system, t0, y0, args, rank)
        part = self.saveat.subs
        solver = _economical(self.solver, self.between())
        view = _View(part.fn, _Decode(self.formulation, self.solver), args)
        return Taped(self.formulation, solver, part, t0, t1, y, ode, view)

    def _forwards(self) -> "Solve":
        """The same solve with forward derivatives."""
        return dataclasses.replace(self, adjoint=diffrax.ForwardMode())

    def derivative(self) -> Any:
        """In which mode the adjoint allows derivatives; a progress meter needs callbacks."""
        if not isinstance(self.progress_meter, diffrax.NoProgressMeter):
            return "any"
        if isinstance(self.adjoint, diffrax.ForwardMode):
            return "forward"
        return "reverse" if isinstance(self.adjoint, diffrax.RecursiveCheckpointAdjoint) else "any"

    def _for_derivative(self, solver: Any, y: Any) -> Any:
        """The solver as diffrax's reverse derivative needs it; the tape knows accepted steps only."""
        size = sum(leaf.size for leaf in jax.tree.leaves(y))
        ours = isinstance(solver, AbstractManifoldSolver | AbstractResidualSolver) and not hasattr(
            solver, "root_finder"
        )
        by_diffrax = self.derivative() == "reverse" and not can_be_taped(self, size)
        return WithoutFailedSteps(solver) if ours and by_diffrax else solver

    def between(self) -> bool:
        """Whether points between steps are asked for."""
        return (
            self.saveat.dense or any(part.ts is not None for part in saved_parts(self.saveat)) or self.event is not None
        )

    def _diffeqsolve(self, system: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, rank: int | Rank | None) -> Any:
        y, ode = self.formulation.encode(system, t0, y0, args, rank)
        decode = _Decode(self.formulation, self.solver)
        solver, controller = _economical(self.solver, self.between()), _fitted(self.controller, t0, t1)
        if isinstance(self.formulation, Residual):
            solver, controller = _of_residuals(solver, controller)
            dt0 = first_step(ode.start, solver, t0, t1, y) if dt0 is None else dt0

        def saved(part: Any) -> Any:
            return part if part.fn is as_it_is else eqx.tree_at(lambda s: s.fn, part, _View(part.fn, decode, args))

        subs = {
            "user": jax.tree.map(saved, self.saveat.subs, is_leaf=is_saved_part),
            "end": diffrax.SubSaveAt(t1=True, fn=decode),
        }
        saveat = eqx.tree_at(lambda s: s.subs, self.saveat, subs, is_leaf=lambda x: x is None)
        event = self.event and dataclasses.replace(
            self.event,
            cond_fn=jax.tree.map(
                lambda c, up: _on_states(c, decode, args, up),
                self.event.cond_fn,
                self.event.direction,
                is_leaf=lambda x: x is None or callable(x),
            ),
        )
        selects = isinstance(solver, SelectedStates | SelectedResiduals)
        saveat = dataclasses.replace(saveat, solver_state=True) if selects else saveat
        sol = diffrax.diffeqsolve(
            self.formulation.term(),
            self._for_derivative(solver, y),
            t0, t1, dt0, y,
            args=ode, saveat=saveat, stepsize_controller=controller, adjoint=self.adjoint, event=event,
            max_steps=self.max_steps, throw=False, progress_meter=self.progress_meter,
        )  # fmt: skip
        interpolation = None
        if sol.interpolation is not None:
            interpolation = Interpolation(_uniform(self.solver, sol.interpolation), decode, ode)
        ts, ys = cast(Any, sol.ts), cast(Any, sol.ys)
        end = jax.lax.stop_gradient(jax.tree.map(lambda x: x[-1], (ts["end"], ys["end"])))
        stats = {**sol.stats, "end_time": end[0]}
        starts = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))
        result = RESULTS.where(starts, RESULTS.promote(sol.result), RESULTS.no_finite_start)
        if selects:
            stats["switches"] = cast(Any, sol.solver_state).switches
        return sol.t0, sol.t1, ts["user"], ys["user"], interpolation, stats, result, sol.event_mask, end

    def _solution(self, out: Any, args: Any, rank: int | Rank | None, found: Any) -> DAESolution:
        *fields, code, event_mask = out
        (start, _), end, (finite_end, defined) = found
        _, _, ts, ys, *_ = fields
        failed = lambda name, instead, when=True: RESULTS.where((code == name) & when, instead, code)
        if isinstance(self.formulation, Residual):
            code = failed(RESULTS.dt_min_reached, RESULTS.error_too_large)
            code = failed(RESULTS.nonlinear_divergence, RESULTS.no_convergence)
            code = failed(RESULTS.singular, RESULTS.singular_iteration_matrix)
        code = failed(RESULTS.dt_min_reached, RESULTS.step_rejected)
        code = failed(RESULTS.nonlinear_divergence, RESULTS.off_manifold)
        finite = [all_finite(*pair) for pair in _saved(self.saveat, ts, ys)] if ts is not None else []
        precision = precision_of(fields[0].dtype, self.controller)
        went_well = (code == RESULTS.successful) | (code == RESULTS.event_occurred)
        code = RESULTS.where(went_well & ~jnp.all(jnp.stack([finite_end, *finite])), RESULTS.not_finite, code)
        # A root finder that met a condition that is not a number ends anywhere, also at a time that is none.
        lost = ~defined | ~jnp.isfinite(fields[5]["end_time"])
        for name in ("nonlinear_max_steps_reached", "nonfinite_input", "nonfinite"):
            code = failed(getattr(RESULTS, name), RESULTS.undefined_condition, lost)
        went_well = (code == RESULTS.successful) | (code == RESULTS.event_occurred)
        code = RESULTS.where(went_well & ~defined, RESULTS.undefined_condition, code)
        stuck = [RESULTS.step_rejected, RESULTS.off_manifold, RESULTS.no_convergence, RESULTS.error_too_large]
        stuck = jnp.any(jnp.stack([code == name for name in (*stuck, RESULTS.singular_iteration_matrix)]))
        code = RESULTS.where(stuck & end.singular, RESULTS.singular_configuration, code)
        code = RESULTS.where(went_well & ~end.near, RESULTS.off_constraints, code)
        code = RESULTS.where(end.masses & (end.masses_ahead | went_well), code, RESULTS.irregular_mass)
        for wrong, name in enumerate(("inconsistent_start", "dependent_constraints", "irregular_mass", "ambiguous_start"), 1):
            code = RESULTS.where(start == wrong, getattr(RESULTS, name), code)
        return DAESolution(*fields, code, event_mask, args, rank[1] if isinstance(rank, tuple) else rank, precision)


def _saved(saveat: Any, ts: Any, ys: Any) -> list[tuple[Any, Any]]:
    """The (times, states) of each part of `saveat`."""
    structure = jax.tree.structure(saveat.subs, is_leaf=is_saved_part)
    return [
        (t, y) for t, y in zip(structure.flatten_up_to(ts), structure.flatten_up_to(ys), strict=True) if t is not None
    ]


def _fitted(controller: Any, t0: Any, t1: Any) -> Any:
    """The controller with a smallest step at the resolution of time, below which a solve cannot get on, and its default
    norm without a library call.
    """
    if type(controller) is not diffrax.PIDController:
        return controller
    if controller.norm is optimistix.rms_norm:
        controller = dataclasses.replace(controller, norm=rms_norm)
    if controller.dtmin is not None:
        return controller
    floor = 16 * jnp.finfo(jnp.result_type(t0)).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    return dataclasses.replace(controller, dtmin=floor, force_dtmin=False)


def _of_residuals(solver: Any, controller: Any) -> tuple[Any, Any]:
    """A solver with the controller's tolerances; it finds by itself where time resolves no smaller step."""
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return solver, controller
    rtol, atol = (getattr(solver, name) or getattr(controller, name) for name in ("rtol", "atol"))
    if type(controller) is diffrax.PIDController:
        controller = dataclasses.replace(controller, dtmin=None)
    return dataclasses.replace(solver, rtol=rtol, atol=atol), controller


def _uniform(solver: Any, path: diffrax.DenseInterpolation) -> diffrax.DenseInterpolation:
    """The dense output with one type of point, also for an interval of length 0."""
    if not isinstance(solver, TangentSpace):
        return path
    first = TangentPoint(path.y0_if_trivial, jax.tree.map(lambda x: x[0], path.infos["normals"]))
    return eqx.tree_at(lambda p: p.y0_if_trivial, path, first)


def _on_states(cond: Callable[..., Any], decode: Any, args: Any, up: bool | None) -> Callable[..., Any]:
    user_args = args

    def condition(t: Any, y: Any, args: Any, **kwargs: Any) -> Any:
        value = cond(t, decode(t, y, args), user_args, **kwargs)
        # NaN crosses in no direction: it ends the solve here, which then says so.
        return value if up is None else jnp.where(jnp.isnan(value), 1 if up else -1, value)

    return condition


def _economical(solver: Any, between: bool) -> Any:
    """The solver without what this solve does not need, with its stages written out."""
    if isinstance(solver, OrthogonalProjection | TangentSpace | SelectedResiduals):
        return dataclasses.replace(solver, solver=_economical(solver.solver, between))
    if isinstance(solver, BDF | DOP853 | RadauIIA5):
        return dataclasses.replace(solver, dense=between)
    return unrolled(solver)
