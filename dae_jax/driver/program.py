"""A solve as a compiled program: what is traced once for a system and a method, and run on numbers."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from .._compat import is_captured, lacks_reverse_derivatives
from ..compiler import PullBack, inexact, one_kernel, one_kernel_enabled, trace_state_clean, waiting
from ..compiler.kernel_call import as_kernel
from ..compiler.types import Arrays
from ..equations.independent import independent
from ..equations.regularity import COARSE
from ..equations.residual_form import LARGE
from ..formulations import AbstractFormulation
from ..solution import DAESolution, Split
from ..solvers import AbstractManifoldSolver, takes_residuals
from ..types import BoolScalar, Scalar, State, Y
from ..validate.captured import settled
from ..validate.user_functions import refuse_wrong_functions, returned
from .between_steps import Flow, has_flow
from .changes import changing, some_changes, with_changes
from .diffrax_call import call, failed, steps_of, took_steps
from .ends import Start, look
from .event_adjoint import stop_of, stopped
from .event_functions import known_to_conditions, refuse_wrong_event
from .failures import refused_on_the_way
from .felt_steps import OneDirection, by_felt_steps
from .followed_steps import Steps, as_bits, if_reached, of_bits
from .outcome import judged
from .problem import Problem, Program, split
from .pull_back import by_trajectory
from .reached import with_derivatives, without_stop
from .resets import Reset, solve_with_resets
from .start import saved_parts
from .switches import warn_of_moving_switches
from .tolerances import span_of
from .trajectory_adjoint import as_it_is, has_trajectory_adjoint


FORWARD_ONLY = (
    "With `adjoint=diffrax.ForwardMode()`, which a Lyapunov exponent is found with too, there are forward derivatives "
    "only: `jax.jvp`, `jax.jacfwd`. For `jax.grad` leave `adjoint` out."
)
# How many problems stay compiled. Each holds 8 MB and more, most of it in JAX's caches of what it has traced.
KEPT = 128
_traced: list[Program] = []


def traces() -> int:
    """How many problems have been traced since JAX was last told to forget some."""
    return len(_traced)


def _make_room() -> None:
    """JAX and equinox keep the traces of thousands of problems: after so many new ones they are told to forget them."""
    if len(_traced) >= KEPT and trace_state_clean():
        _traced.clear()
        jax.clear_caches()


@functools.partial(jax.jit, static_argnums=(0, 2))
def _jitted(program: Program, arrays: Arrays, within: bool) -> Any:
    """`within` other programs also how far the start is from the constraints: there it cannot be found afterwards."""
    _traced.append(program)
    solve, problem = program.whole(jax.tree.map(jnp.asarray, arrays))
    waiting.begin(always=not isinstance(solve.progress_meter, diffrax.NoProgressMeter))
    solve.refuse_wrong_functions(problem)
    with settled(program.leaves):
        if isinstance(solve.event, Reset):
            sol, start = solve_with_resets(solve, problem)
        else:
            sol, start = solve(problem)
            sol = without_stop(sol, solve.saveat)
    return Split.of(with_derivatives(sol, inexact(arrays))), start if within else start._replace(off=None)


@functools.partial(jax.jit, static_argnums=0)
def _numbers(program: Program, arrays: Arrays, steps: Steps | None = None) -> Split:
    """diffrax's part of a solve; jitted, so that derivatives and batches of it find it traced."""
    solve, problem = program.whole(arrays)
    with settled(program.leaves):
        at = None if steps is None else of_bits(steps)
        found = call(solve, problem, at)
        return if_reached(Split.of(found), at, took_steps(found))


def _refuse_reverse(*_: object) -> Any:
    raise TypeError(FORWARD_ONLY)


def run(program: Program, arrays: Arrays) -> tuple[DAESolution, Start, float]:
    """The solution, what its start was like, and the seconds spent on compiling."""
    _make_room()
    within = not trace_state_clean() or any(isinstance(x, Tracer) for x in arrays)
    try:
        sol, start = _jitted(program, arrays, within)
    except TypeError as error:
        if is_captured(error):
            raise TypeError(
                "A number that is being differentiated is held by an object that is no pytree (an attribute, a global "
                "variable), where the solve cannot see it. Hand it over through `args`, or make the object an `equinox.Module`."
            ) from error
        raise
    except ValueError as error:
        if lacks_reverse_derivatives(error):
            raise TypeError(FORWARD_ONLY) from error
        raise
    finally:
        seconds = waiting.end(all_made=True)
    return sol.whole(), start, seconds


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("formulation", "solver", "saveat", "controller", "adjoint", "event", "progress_meter"),
    meta_fields=("max_steps", "throw", "recording", "counts_between", "raises_index"),
)
@dataclasses.dataclass(frozen=True, eq=False)
class Solve:
    """All that is fixed about a solve, as one callable for `jit`."""

    formulation: AbstractFormulation
    solver: diffrax.AbstractSolver
    saveat: diffrax.SaveAt
    controller: diffrax.AbstractStepSizeController
    adjoint: diffrax.AbstractAdjoint
    event: diffrax.Event | Reset | None
    progress_meter: diffrax.AbstractProgressMeter
    max_steps: int | None
    # Whether a derivative that is not known is an error.
    throw: bool = False
    # Whether it is done again for its trajectory, which the dense output is there for, or its steps alone.
    recording: bool = False
    # Whether steps are to be good between their ends though nothing is saved there.
    counts_between: bool = False
    # Whether a reset may have raised the index of the equations.
    raises_index: bool = False

    def __call__(self, problem: Problem) -> tuple[DAESolution, Start]:
        backwards = problem.t1 < problem.t0
        self = dataclasses.replace(self, formulation=self.formulation.towards(jnp.where(backwards, -1, 1)))
        numbers, arrays = self.kernel(problem)
        forward, _ = self.forwards().kernel(problem)
        pull_back = self._pull_back(problem)
        way = (lambda args, result: as_bits(result.numbers[-1])) if self.records_steps() else self._felt_steps(problem)
        kind = self.derivative() if way is None else "reverse"
        noticed = functools.partial(warn_of_moving_switches, split((self, problem))[0])
        *fields, end, _ = one_kernel(numbers, kind, pull_back, forward, way, noticed=noticed)(arrays).whole()
        check, check_arrays = self._check(problem, end)
        # What is looked at has no derivative.
        found = one_kernel(check, self.derivative(), often=False)(jax.lax.stop_gradient(check_arrays))
        return judged(self, fields, problem, found, end), found[0]

    def keeps(self) -> tuple[bool, bool]:
        """Whether g and (ġ, h) hold at each step."""
        return (True, True) if isinstance(self.solver, AbstractManifoldSolver) else self.formulation.keeps

    def needs_independent(self) -> bool:
        """Whether the method cannot do with redundant constraints."""
        return self.formulation.needs_independent or getattr(self.solver, "needs_independent", False)

    def encoded(self, problem: Problem) -> tuple[Any, Any]:
        """The start in the solver's variables, and the equations that it gets."""
        start = problem.t0, problem.y0, problem.args
        if problem.rank is None or not self.needs_independent():
            return self.formulation.encode(problem.system, *start, problem.rank)
        return self.formulation.encode(independent(*problem.start, problem.rank, problem.rows), *start)

    def refuse_wrong_functions(self, problem: Problem) -> None:
        """Refuses, in a sentence, functions that do not take or return what they must, and a system that the method is not for."""
        system, *start = problem.start
        refuse_wrong_functions(system, *start)
        self.formulation.refuse(system)
        if isinstance(self.solver, AbstractManifoldSolver):
            self.solver.refuse(system, self.formulation, *start)
        refuse_wrong_event(self.event, *problem.start[1:], known_to_conditions(self, problem))
        for part in saved_parts(self.saveat):
            returned("saveat.fn(t, y, args)", part.fn, *start)

    def _check(self, problem: Problem, end: tuple[Scalar, State]) -> tuple[Callable[..., Any], list[Any]]:
        """What is wrong with the start and the end, as a function of arrays, and its arrays."""
        residual = takes_residuals(self.solver)
        # Points between the steps of a solver of residuals are off by what its dense output is.
        keeps = (False, False) if residual and self.event is not None else self.keeps()
        if isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController):
            tolerances = tuple(span_of(getattr(self.controller, name)) for name in ("rtol", "atol"))
        else:
            tolerances = ((0.0, 0.0),) * 2 if residual else ((COARSE, COARSE),) * 2
        known = {} if self.event is None else known_to_conditions(self, problem)
        program, arrays = split((*problem.start, end, tolerances, self.event, known))
        invertible, rank, rows = self.formulation.inverts_mass, problem.rank, problem.rows

        def check(arrays: Arrays) -> Any:
            system, t0, y0, args, end, tolerances, event, known = program.whole(arrays)
            t, state = end
            conditions = [] if event is None else jax.tree.leaves(event.cond_fn, is_leaf=callable)
            finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(state)]
            defined = [~jnp.isnan(condition(t, state, args, **known)) for condition in conditions]
            numbers = (jnp.all(jnp.stack(finite)), jnp.all(jnp.asarray(defined, bool)))
            return *look(system, t0, y0, args, rank, rows, invertible, end, keeps, tolerances, residual), numbers

        return check, arrays

    def kernel(self, problem: Problem) -> tuple[Callable[..., Split], list[Any]]:
        """What can become one kernel: a function of arrays, and of the steps to take, if that is known; and its arrays."""
        program, arrays = split((self, problem))

        def numbers(arrays: Arrays, *steps: Steps) -> Split:
            # JAX's derivatives name the (empty) mesh, and would trace anew what was traced without a name for it.
            with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
                return _numbers(program, arrays, *steps)

        return numbers, arrays

    def _pull_back(self, problem: Problem) -> PullBack | None:
        """The reverse derivative from the trajectory, where it applies."""
        if self.derivative() == "forward":
            return _refuse_reverse
        size = sum(leaf.size for leaf in jax.tree.leaves(problem.y0))
        if self.derivative() != "reverse" or not has_trajectory_adjoint(self, size):
            return None
        return by_trajectory(split((self, problem))[0])

    def _felt_steps(self, problem: Problem) -> Callable[..., Steps] | None:
        """The steps of derivatives, which are the same for all of them: in the sum of a second derivative's parts, what leads off
        the manifold cancels only if these have the same steps.
        """
        most = self.max_steps
        if most is None or not self.has_steps_of_derivatives(sum(leaf.size for leaf in jax.tree.leaves(problem.y0))):
            return None
        saveat = diffrax.SaveAt(subs=diffrax.SubSaveAt(t1=True, fn=as_it_is))
        program, _ = split((self, problem))

        def changes_of(arrays: Arrays, end: Any) -> Any:
            with settled(program.leaves):
                solve, problem = program.whole(arrays)
                return some_changes(solve, problem, end, takes_residuals(self.solver))

        def steps(arrays: Arrays, changes: Any, failed: BoolScalar) -> Steps:
            with settled(program.leaves):
                solve, problem = program.whole(arrays)
                given, rest = changing(solve, problem)
                # Of solvers of residuals the error between steps counts, if points there are asked for.
                between = solve.between() and takes_residuals(solve.solver)
                again = {"adjoint": OneDirection(), "saveat": saveat, "counts_between": between, "recording": True}
                solve = dataclasses.replace(solve, **again)
                solved = lambda given: steps_of(*with_changes(solve, problem, eqx.combine(given, rest)), failed)
                return by_felt_steps(solved, given, changes)

        def way(args: tuple[Arrays], out: Split) -> Steps:
            *_, end, _ = out.whole()
            (arrays,), end = jax.lax.stop_gradient((args, end))
            problem = program.whole(arrays)[1]
            changes = as_kernel(changes_of, often=False)(arrays, end)
            found = as_kernel(steps)(arrays, changes, failed(out, problem))
            if self.event is not None:
                found = stopped(found, stop_of(jax.lax.stop_gradient(out.whole())), problem.t1 < problem.t0)
            return refused_on_the_way(found, most) if self.throw else found

        return way

    def flow(self) -> Flow:
        """Where points move with their time: the time of an event is that where a condition is zero, whose derivative by others, at that
        time, has one by it.
        """
        return Flow(self.formulation, self.derivative() == "any" or self.event is not None, self.raises_index)

    def is_still(self, y: Y) -> bool:
        """Whether the steps of a solve from y do not move with times: all but fixed ones, of which the solution is what they give."""
        moves = self.event is None and not isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController)
        return not moves and has_flow(self.formulation, y)

    def forwards(self) -> "Solve":
        """The same solve with forward derivatives."""
        return dataclasses.replace(self, adjoint=diffrax.ForwardMode())

    def derivative(self) -> Any:
        """In which mode the adjoint allows derivatives; a progress meter needs callbacks."""
        if not isinstance(self.progress_meter, diffrax.NoProgressMeter):
            return "any"
        if isinstance(self.adjoint, diffrax.ForwardMode):
            return "forward"
        return "reverse" if isinstance(self.adjoint, diffrax.RecursiveCheckpointAdjoint) else "any"

    def saves_steps(self) -> bool:
        """Whether what is saved belongs to steps whose sizes are chosen on the way."""
        of_steps = self.saveat.dense or any(part.steps for part in saved_parts(self.saveat))
        return of_steps and isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController)

    def has_derivative_apart(self) -> bool:
        """Whether the derivative is a program of its own."""
        in_its_own_steps = self.derivative() == "any" or isinstance(self.adjoint, OneDirection)
        return not in_its_own_steps and one_kernel_enabled() and not self.recording

    def has_steps_of_derivatives(self, size: int) -> bool:
        """Whether derivatives, with `size` unknowns, have steps of their own."""
        adaptive = isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController)
        return adaptive and self.has_derivative_apart() and self.max_steps is not None and size <= LARGE

    def records_steps(self) -> bool:
        """Whether the steps are written down for the derivative."""
        return self.saves_steps() and self.has_derivative_apart()

    def between(self) -> bool:
        """Whether points between steps are asked for, or count."""
        at_times = any(part.ts is not None for part in saved_parts(self.saveat))
        dense = self.saveat.dense and not self.recording
        return self.counts_between or dense or at_times or self.event is not None
