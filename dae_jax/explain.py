"""What a solve will do, in words: what was found in the system, what is therefore left out, and how it is compiled."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, Float, PyTree

from .compiler import Decision, at_ease, decision, equations, one_kernel_enabled, without_checks
from .driver.program import Solve
from .driver.resets import Reset
from .equations.linearised import LinearisedResidual
from .equations.mechanical import MechanicalODE
from .equations.sparse_constraint_jacobian import SparseConstraintJacobian
from .formulations import AbstractFormulation
from .linalg import SparseDefinite
from .linalg.semidefinite import LOOPED, UNROLLED
from .solution import precision_of
from .solve import of_known_rank, prepared
from .solvers import takes_residuals
from .systems import ConstrainedSystem, System, is_mechanism
from .tables import table
from .types import Args, Controller, Flat, ProgressMeter, Solver, State, Time
from .validate.states import counted, refuse_no_time, with_rates
from .validate.user_functions import at_numbers


_COMPILERS = {"llvm": "yes, by our compiler (LLVM)", "xla kernel": "yes, by XLA", "xla": "no, XLA as it is"}


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a system is solved; `print` it. `explain` gives a `MechanicalPlan`, a `StructuralPlan` or a `ResidualPlan`.

    - `method`: formulation and solver, in words.
    - `precision`: the numbers' type, and the tolerances.
    - `linear_solver`: how the linear systems of a step are solved.
    - `operations`: primitive operations of one evaluation of the field or the residual, as it is compiled.
    - `one_kernel`: whether the whole loop is compiled to one kernel; with a `Reset` the loop from one to the next.
    - `compiler`: who compiles it: "llvm", our compiler, as one kernel; "xla kernel", XLA as one kernel; "xla", XLA as many.
      `batch_compiler`: the same of a batch of starts under `vmap`; "xla" where XLA does it, in whatever form.
    - `reasons`: what our compiler does not take, with the equation; `unsupported`: the primitives of these equations.
    - `left_out`: what other systems need and this one does not.
    """

    method: str
    precision: str
    linear_solver: str
    operations: int
    compiler: str
    batch_compiler: str
    reasons: tuple[str, ...]
    unsupported: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def one_kernel(self) -> bool:
        return self.compiler != "xla"

    @property
    def hindrances(self) -> tuple[str, ...]:
        """The former name of `unsupported`."""
        warnings.warn("`hindrances` of a plan is called `unsupported` now.", DeprecationWarning, stacklevel=2)
        return self.unsupported

    def __str__(self) -> str:
        return "\n".join(f"{name:>20}  {text}" for name, text in self._rows().items())

    def _repr_html_(self) -> str:
        return table(type(self).__name__, self._rows())

    def _rows(self) -> dict[str, str]:
        why = "".join(f"; {reason}" for reason in self.reasons)
        batch = "lanes of vectors" if self.batch_compiler == "llvm" else "left to XLA"
        return {
            "method": self.method,
            "precision": self.precision,
            **self._found(),
            "one kernel": _COMPILERS[self.compiler] + why,
            "batch": batch,
            "left out": "; ".join(self.left_out) or "nothing",
        }

    def _found(self) -> dict[str, str]:
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class MechanicalPlan(Plan):
    """Of the underlying ODE of a mechanism.

    - `coordinates`, `constraints`, `independent`: counts; `independent` is `None` where the start is traced.
    - `mass`: "unit", "diagonal" or "matrix", and whether it depends on q.
    - `constraints_depend_on_time`.
    - `nonzeros`, `colours`: nonzeros of the constraints' Jacobian, and the directional derivatives that it takes; `None`
      where it is dense.
    - `chart`: of how many numbers the chart of a `StateSpace` is, which has neither multipliers nor that Jacobian; else `None`.
    """

    coordinates: int
    constraints: int
    independent: int | None
    mass: str
    constraints_depend_on_time: bool
    nonzeros: int | None
    colours: int | None
    chart: int | None = None

    def _found(self) -> dict[str, str]:
        independent = self.constraints if self.independent is None else self.independent
        redundant = "" if independent == self.constraints else f", {independent} of them independent"
        jacobian = "dense, by forward-mode derivatives"
        if self.nonzeros is not None and self.colours is not None:
            jacobian = f"{counted(self.nonzeros, 'nonzero')} from {counted(self.colours, 'directional derivative')}"
        if self.chart is not None:
            jacobian = f"none, that of the chart by {counted(self.chart, 'directional derivative')}"
        return {
            "system": f"{counted(self.coordinates, 'coordinate')}, {counted(self.constraints, 'constraint')}{redundant}",
            "mass": self.mass,
            "time": f"constraints {'depend on' if self.constraints_depend_on_time else 'are fixed in'} time",
            "constraint Jacobian": jacobian,
            "multipliers": self.linear_solver,
            "field": counted(self.operations, "operation"),
        }


@dataclasses.dataclass(frozen=True)
class StructuralPlan(Plan):
    """Of the underlying ODE that structural analysis finds for any system.

    - `unknowns`, `state`: how many the equations have, and of how many numbers the state of the ODE consists.
    - `differentiated`: how often each equation is differentiated.
    - `invariants`: the constraints and the hidden ones.
    """

    unknowns: int
    state: int
    differentiated: tuple[int, ...]
    invariants: int

    def _found(self) -> dict[str, str]:
        often = [
            f"{self.differentiated.count(k)} of them {counted(k, 'time')}"
            for k in sorted(set(self.differentiated))
            if k
        ]
        return {
            "system": f"{counted(self.unknowns, 'equation')}, differentiated: {', '.join(often) or 'none'}",
            "underlying ODE": f"{counted(self.state, 'number')} with {counted(self.invariants, 'invariant')}",
            "linear systems": self.linear_solver,
            "field": counted(self.operations, "operation"),
        }


@dataclasses.dataclass(frozen=True)
class ResidualPlan(Plan):
    """Of 0 = F(t, y, ẏ) as it is written.

    - `unknowns`; `indices`: the index of each, by which its errors are weighted.
    - `derivatives`: of how many unknowns the derivative occurs.
    - `colours`: directional derivatives for ∂F/∂y and ∂F/∂ẏ; `gradients`: rows of both with so many entries that they are found by
      themselves, in reverse mode.
    """

    unknowns: int
    indices: tuple[int, ...]
    derivatives: int
    colours: tuple[int, int]
    gradients: int = 0

    def _found(self) -> dict[str, str]:
        counts = [f"{self.indices.count(k)} of index {k}" for k in sorted(set(self.indices))]
        by_y, by_rate = self.colours
        rows = f", {counted(self.gradients, 'full row')} in reverse mode" if self.gradients else ""
        return {
            "system": f"{counted(self.unknowns, 'unknown')}, derivatives of {self.derivatives} occur",
            "unknowns": ", ".join(counts),
            "Jacobians": f"∂F/∂y from {counted(by_y, 'directional derivative')}, ∂F/∂ẏ from {by_rate}{rows}",
            "linear systems": self.linear_solver,
            "residual": counted(self.operations, "operation"),
        }


@at_ease
@at_numbers
def explain(
    system: System,
    solver: Solver,
    t0: Time,
    y0: State,
    args: Args = None,
    *,
    dt0: Time | None = None,
    formulation: AbstractFormulation | None = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    stepsize_controller: Controller | None = None,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),  # noqa: B008
    event: diffrax.Event | Reset | None = None,
    progress_meter: ProgressMeter = diffrax.NoProgressMeter(),  # noqa: B008
    yd0: State = None,
) -> Plan:
    """How `daesolve` would solve this, with the same arguments; nothing is solved. Where steps are fixed for any reason but `dt0`, that
    may be left out.

    Errors: those of `daesolve` for wrong input; `ValueError` within `jit`, `vmap` and `grad` of what is looked at.
    """
    refuse_no_time("t0", t0)
    adaptive = isinstance(solver, diffrax.AbstractAdaptiveSolver)
    if dt0 is None and (not adaptive or isinstance(stepsize_controller, diffrax.ConstantStepSize)):
        dt0 = 1e-3
    solve, problem = prepared(
        with_rates(system, yd0, y0), solver, t0, t0 + 1.0, dt0, y0, args, formulation, saveat, stepsize_controller, adjoint, event, 4096,
        progress_meter,
    )  # fmt: skip
    solve, problem = jax.tree.map(
        lambda x: jnp.asarray(x) if isinstance(x, np.ndarray | np.generic) else x, (solve, problem)
    )
    system, t0, y0, args = problem.start
    traced = any(isinstance(x, Tracer) for x in jax.tree.leaves((solve, problem)))
    problem = problem if traced else of_known_rank(solve, problem)
    solve.refuse_wrong_functions(problem)
    precision = precision_of(jnp.result_type(t0), solve.controller)
    resets = isinstance(solve.event, Reset)
    if resets:  # each part is a solve that an event ends
        solve = dataclasses.replace(solve, event=diffrax.Event(solve.event.condition))
    kernel, arrays = solve.kernel(problem)
    starts = jax.tree.leaves(y0)
    jaxpr = jax.make_jaxpr(without_checks(kernel))(arrays)
    compiled = _compiled(solve, jaxpr, [any(x is start for start in starts) for x in arrays])
    method = f"{(formulation or solve.formulation).named(system)}, {_name(solver)}{', from reset to reset' * resets}"
    y, ode = eqx.filter_eval_shape(solve.encoded, problem)
    if takes_residuals(solve.solver):
        linearised = ode.solved_by(solve.solver.linear_solver)
        return _of_residual(linearised, t0, y, method, precision, compiled)
    operations = _operations(solve.formulation.field, t0, y, ode)
    if solve.formulation.selects_states or not is_mechanism(system):
        return StructuralPlan(
            method=method,
            precision=precision,
            linear_solver=ode.tearing.describe(ode.form.size),
            operations=operations,
            **compiled,
            left_out=() if solve.between() else ("dense output",),
            unknowns=ode.form.size,
            state=ode.orders.size,
            differentiated=ode.orders.equations,
            invariants=sum(ode.orders.equations),
        )
    chart = None if solve.formulation.leaves_constraints else sum(x.size for x in jax.tree.leaves(y)) // 2
    ode = ode if chart is None else ode.mechanical
    given = MechanicalODE.of(system, t0, y0, args, problem.rank)
    count = given.holonomic + given.nonholonomic
    sparse = ode.linear if isinstance(ode.linear, SparseConstraintJacobian) else None
    eliminated = _linear_solver(ode) if chart is None else f"none, {_elimination(counted(chart, 'coordinate'), chart)}"
    return MechanicalPlan(
        method=method,
        precision=precision,
        linear_solver=eliminated,
        operations=operations,
        **compiled,
        left_out=tuple(_left_out(ode, solve)),
        coordinates=ode.layout.size,
        constraints=count,
        independent=None if traced else given.rank[1] if given.rank else count,
        mass=_mass(system, given.mass(given.encode(y0)[0])),
        constraints_depend_on_time=any(ode.depends_on_time),
        nonzeros=None if sparse is None else int((sparse.columns >= 0).sum()),
        colours=None if sparse is None else len(sparse.columns),
        chart=chart,
    )


def _compiled(solve: Solve, jaxpr: ClosedJaxpr, starts: list[bool]) -> dict[str, Any]:
    """Who compiles a solve's loop, and why; `starts`: which of its arguments a batch of starts has lanes of."""
    off = "off: derivatives through the loop, a progress meter, a switch, or neither a CPU nor a GPU"
    if not one_kernel_enabled() or solve.derivative() == "any":
        return {"compiler": "xla", "batch_compiler": "xla", "reasons": (off,), "unsupported": ()}
    alone, batch = decision(jaxpr), decision(jaxpr, starts) if any(starts) else Decision("xla", ())
    reasons: dict[str, str] = {}
    for found in (*alone.unsupported, *batch.unsupported):
        reasons.setdefault(found.reason, str(found))
    return {
        "compiler": alone.compiler,
        "batch_compiler": "llvm" if batch.compiler == "llvm" else "xla",
        "reasons": tuple(reasons.values()),
        "unsupported": tuple(dict.fromkeys(found.primitive for found in alone.unsupported)),
    }


def _of_residual(
    linearised: LinearisedResidual, t0: Time, y: Flat, method: str, precision: str, compiled: dict[str, Any]
) -> ResidualPlan:
    structure, n = linearised.structure, y.size
    compressed = structure.by_y, structure.by_rate
    by_y, by_rate = (n if c is None else c.count for c in compressed)
    colours = by_y, by_rate
    return ResidualPlan(
        method=method,
        precision=precision,
        linear_solver=structure.storage.describe(),
        operations=_operations(lambda y, linearised: linearised.residual(t0, y, y), y, linearised),
        **compiled,
        left_out=("directional derivatives of structural zeros",) if sum(colours) < 2 * n else (),
        unknowns=n,
        indices=structure.indices,
        derivatives=int(structure.differential.sum()),
        colours=colours,
        gradients=sum(len(c.full) for c in compressed if c is not None),
    )


def _name(module: eqx.Module) -> str:
    inner = getattr(module, "solver", None)
    return type(module).__name__ + (f"({_name(inner)})" if inner is not None else "")


# What a mass of two and of three axes is.
_MATRICES = {2: "a full mass matrix", 3: "a block-diagonal mass matrix"}


def _mass(system: ConstrainedSystem, mass: Float[Array, "..."] | None) -> str:
    kind = "unit masses" if mass is None else "diagonal masses" if mass.ndim < 2 else _MATRICES[mass.ndim]
    return kind + (f" that {'depend' if kind.endswith('masses') else 'depends'} on q" if callable(system.mass) else "")


def _linear_solver(ode: MechanicalODE) -> str:
    count = ode.holonomic + ode.nonholonomic
    if isinstance(ode.linear, SparseConstraintJacobian):
        schur = ode.linear.schur
        if isinstance(schur, SparseDefinite):
            return f"sparse elimination along the diagonal, {counted(schur.symbolic.cost, 'multiplication')}"
        return (
            f"sparse elimination in {counted(len(schur.levels), 'level')}, {counted(schur.cost, 'multiplication')}"
            + (f", then a dense system of {schur.rest_size}" if schur.rest_size > 1 else "")
        )
    some = "" if ode.rank is None else f"the {ode.rank[1]} that are independent of "
    return _elimination(some + counted(count, "constraint" if some else "unknown"), count)


def _elimination(of: str, count: int) -> str:
    kind = "straight-line" if count <= UNROLLED else "a loop over columns" if count <= LOOPED else "Cholesky (LAPACK)"
    return f"dense elimination of {of}, {kind}"


def _left_out(ode: MechanicalODE, solve: Solve) -> Iterator[str]:
    if ode.system.mass is None:
        yield "mass solve"
    if not any(ode.depends_on_time):
        yield "time derivatives of the constraints"
    if not ode.nonholonomic:
        yield "nonholonomic constraints"
    yield "multipliers as output"
    if not solve.between():
        yield "dense output"


def _operations(fn: Callable[..., Any], *args: PyTree) -> int:
    """How many primitive operations a function has, those that only move data left out."""
    moved = {
        "reshape",
        "squeeze",
        "broadcast_in_dim",
        "slice",
        "concatenate",
        "transpose",
        "convert_element_type",
        "copy",
    }
    names = [eqn.primitive.name for eqn in equations(eqx.filter_make_jaxpr(fn)(*args)[0])]
    return sum(name not in moved and name not in ("jit", "pjit", "stack") for name in names)
