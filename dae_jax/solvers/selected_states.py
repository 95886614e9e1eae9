"""Steps in coordinates that are chosen among the entries of the state, and chosen again when they turn bad."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..equations.manifold_ode import constant
from ..equations.state_selection import orientation, selection
from ..equations.structural_ode import OFF, StructuralODE
from ..linalg import row_products, solve
from ..types import BoolLike, Time, Y
from .chart_steps import AbstractChartSolver
from .manifold import or_nan, outcome, time_sign
from .replay import Replayable
from .residual_steps import AbstractResidualSolver


# Of the way to a root, what Newton's first correction may miss: half of it and more where another root is as near. At the stages
# less, as a step that leaps over roots comes near one by chance.
NEAREST, STRAIGHT = 0.5, 0.05
# Where in a step, for what is asked for between steps, it is looked at too.
WITHIN = (0.3, 0.7)


class Selection(NamedTuple):
    """What a step leaves to the next: the inner solver's state (ẏ at the step's end for an explicit one), the directions of
    the entries that are not integrated, and how often these have changed.
    """

    inner: Any
    directions: Any
    switches: Any


def _selected(
    ode: StructuralODE, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, ydot: Any, chosen: Any
) -> tuple[Any, Any, Any]:
    """The directions for the step from t₀ to t₁, whether they are not those `chosen` before, and the leading matrix at its start."""
    sign = time_sign(terms, t0, t1)
    start = ode.leading(sign * t0, y0)
    ahead = ode.leading(sign * t1, y0 + terms.contr(t0, t1) * ydot) if ode.varying else start
    return *selection(ode.orders, start, chosen, ahead), start


def _stays(ode: StructuralODE, directions: Any, start: Any, end: Any) -> Any:
    """Whether the others determine the dummy derivatives all the way between these leading matrices."""
    return jnp.all(orientation(ode.orders, start, directions) * orientation(ode.orders, end, directions) > 0)


class SelectedStates(Replayable, AbstractChartSolver):
    """A step of an explicit solver in some entries of the state, its *states*; the others, as many as there are
    constraints, are found from H(t, y) = 0 by Newton's method at each stage. Used by `DummyDerivatives`, which see.

    Of several roots the one is meant that the motion leads to: Newton's method starts from the integral of the others' own
    derivatives, and a step from which another root could be reached is done again with a smaller one. `dense` says whether
    points between steps are asked for, which are found likewise.
    """

    dense: bool = True

    recomputable: ClassVar[bool] = False
    counts: ClassVar[tuple[str, ...]] = ("switches",)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Selection:
        directions, _ = selection(args.orders, args.leading(time_sign(terms, t0, t1) * t0, y0))
        return Selection(terms.vf(t0, y0, args), directions, jnp.asarray(0))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Selection,
        made_jump: BoolLike,
    ) -> Any:
        sign = time_sign(terms, t0, t1)
        directions, switched, start = _selected(args, terms, t0, t1, y0, solver_state.inner, solver_state.directions)
        y1, error, dense, derivative, result = self.step_in(
            directions, terms, t0, t1, y0, args, solver_state.inner, made_jump
        )
        if len(directions):
            stays = _stays(args, directions, start, args.leading(sign * t1, y1))
            if self.dense:
                stays &= self._is_found_within(sign, t0, t1, dense, args)
            if error is not None:
                jacobian = args.jacobian(sign * t1, y1)
                stays &= _leads_back(args, sign * t1, y1, error, jacobian, directions)
                # Entries that are not integrated are off by what follows from the error of the others.
                follows = solve(row_products(jacobian, directions), jnp.sum(jacobian * error, 1))
                error = or_nan(stays, error - jnp.sum(directions * follows[:, None], 0))
            y1, result = or_nan(stays, y1), diffrax.RESULTS.where(stays, result, outcome(stays))
        return y1, error, dense, Selection(derivative, directions, solver_state.switches + switched), result

    def along(self, dy: Y, chart: Any, ode: StructuralODE) -> Any:
        return dy

    def lift(self, t: Time, u: Y, chart: Any, ode: StructuralODE, between: bool = False) -> Any:
        return ode.retract_along(t, u, chart, NEAREST if between else STRAIGHT)

    def _is_found_within(self, sign: Any, t0: Time, t1: Time, dense: Any, ode: StructuralODE) -> Any:
        path, found = self.interpolation_cls(t0=t0, t1=t1, **dense), []
        for part in WITHIN:
            t = t0 + part * (t1 - t0)
            point = path.evaluate(t)
            found.append(self.lift(sign * t, point.y, point.jacobian, ode)[1])
        return jnp.all(jnp.stack(found))

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> Any:
        derivative = terms.vf(t0, y0, args)
        y1, _, dense, *_ = self.step_in(dense["jacobian"], terms, t0, t1, y0, args, derivative, False)
        return y1, history, dense


def _leads_back(ode: StructuralODE, t: Time, y: Any, error: Any, jacobian: Any, directions: Any) -> Any:
    """Whether Newton's method leads back to y from as far off as the error, or as round-off, to either side."""
    matrix = row_products(jacobian, directions)
    terms = row_products(jnp.abs(jacobian), jnp.abs(y)[None])[:, 0]
    round_off = OFF * float(jnp.finfo(y.dtype).eps) * jnp.abs(solve(matrix, terms))
    off = jnp.abs(jnp.sum(directions * error, 1)) + round_off
    found = []
    for side in (1, -1):
        beside = y + side * jnp.sum(directions * off[:, None], 0)
        missed = side * off - solve(matrix, ode.violations(t, beside))
        found.append(jnp.max(jnp.abs(missed)) <= NEAREST * jnp.max(off))
    return jnp.all(jnp.stack(found))


class SelectedResiduals(Replayable, AbstractResidualSolver):
    """A step of a solver of residuals on an `Index1Form`, in which the entries that are not integrated are algebraic
    variables. The unknowns are the same whatever is selected, so that a multistep method keeps its history. Used by
    `DummyDerivatives`, which see.
    """

    solver: AbstractResidualSolver = dataclasses.field(kw_only=True)

    highest_index = 1
    default_index = 1

    @property
    def counts(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of selections, and those of the solver."""
        return ("switches", *(f"inner.{path}" for path in self.solver.counts))

    @property
    def interpolation_cls(self) -> Any:
        return lambda t0, t1, inner, directions: self.solver.interpolation_cls(t0=t0, t1=t1, **inner)

    def order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.error_order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Selection:
        return Selection(self.solver.init(terms, t0, t1, y0, args), constant(args.form.directions), jnp.asarray(0))

    def invalidate_jacobian(self, state: Selection) -> Selection:
        return state._replace(inner=self.solver.invalidate_jacobian(state.inner))

    def formula(self, state: Selection) -> Any:
        return self.solver.formula(state.inner)

    def by_formula(self, state: Selection, formula: Any) -> Selection:
        return state._replace(inner=self.solver.by_formula(state.inner, formula))

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        solver_state: Selection,
        made_jump: BoolLike,
    ) -> Any:
        ode, sign = args.form.ode, time_sign(terms, t0, t1)
        y, ydot = (x[: ode.orders.size] for x in (y0, args.form.known_ydot(y0)))
        directions, switched, start = _selected(ode, terms, t0, t1, y, ydot, solver_state.directions)
        solver = dataclasses.replace(self.solver, rtol=self.rtol, atol=self.atol)
        state = jax.tree.map(
            lambda a, b: jnp.where(switched, a, b), self.invalidate_jacobian(solver_state), solver_state
        )
        y1, error, dense, inner, result = solver.step(
            terms, t0, t1, y0, _with_dummies(args, directions), state.inner, made_jump
        )
        dense = {"inner": dense, "directions": directions}
        if len(directions):
            stays = _stays(ode, directions, start, ode.leading(sign * t1, y1[: ode.orders.size]))
            y1, error = or_nan(stays, y1), or_nan(stays, error)
            result = diffrax.RESULTS.where(stays, result, outcome(stays))
        return y1, error, dense, Selection(inner, directions, solver_state.switches + switched), result

    def history_at_start(self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any) -> Any:
        solver: Any = self.solver
        return solver.history_at_start(terms, t0, t1, y0, args)

    def history_after(self, dense: Any) -> Any:
        solver: Any = self.solver
        return solver.history_after(dense["inner"])

    def replay(
        self, terms: diffrax.AbstractTerm, t0: Time, t1: Time, y0: Any, args: Any, history: Any, dense: Any
    ) -> Any:
        solver: Any = self.solver
        linearised = _with_dummies(args, dense["directions"])
        y1, history, inner = solver.replay(terms, t0, t1, y0, linearised, history, dense["inner"])
        return y1, history, {**dense, "inner": inner}


def _with_dummies(args: Any, directions: Any) -> Any:
    """The linearised `Index1Form` with these entries as algebraic variables."""
    return eqx.tree_at(lambda p: p.form.directions, args, directions)
