"""Steps of an explicit solver in a chart of the manifold, from whose points a direction leads back on to it."""

import abc
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ..types import BoolLike, Time, Y
from ..validate.states import brief
from .abilities import is_explicit
from .explicit import identity, unrolled
from .manifold import AbstractManifoldSolver, or_nan, outcome, time_sign


# A step may be this much longer than the time times the speed at its two ends.
SPEEDS = 10


class ChartPoint(eqx.Module):
    """A point of a step's chart, with the directions that lead back on to the manifold."""

    y: Any
    jacobian: Any


class _Interpolation(diffrax.AbstractLocalInterpolation):
    t0: Any
    t1: Any
    inner: Any
    jacobian: Any
    cls: Any = eqx.field(static=True)

    def evaluate(self, t0: Time, t1: Any = None, left: bool = True) -> Any:
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        return ChartPoint(self.cls(t0=self.t0, t1=self.t1, **self.inner).evaluate(t0), self.jacobian)


class AbstractChartSolver(AbstractManifoldSolver, diffrax.AbstractAdaptiveSolver):
    """A step of `solver`, an explicit one, in a chart: `step_in`. Between steps, points of the chart go on to the manifold.

    A chart gives a point u of its own the one on the manifold, `lift`, and a derivative ẏ that of u, `along`.
    """

    solver: diffrax.AbstractSolver

    # Its dense output is in the coordinates of the step.
    locates_events: ClassVar[bool] = False

    def __check_init__(self) -> None:
        if not is_explicit(self.solver):
            raise ValueError(
                f"{type(self).__name__} takes an explicit Runge–Kutta solver such as diffrax.Tsit5(), but got {brief(self.solver)}. "
                "For an implicit one use OrthogonalProjection."
            )

    @property
    def term_structure(self) -> Any:
        return diffrax.ODETerm

    @property
    def interpolation_cls(self) -> Any:
        inner = self.solver.interpolation_cls
        return lambda t0, t1, inner_info, jacobian: _Interpolation(t0, t1, inner_info, jacobian, inner)

    @abc.abstractmethod
    def along(self, dy: Y, chart: Any, ode: Any) -> Any:
        """u̇ of ẏ."""

    def lift(self, t: Time, u: Y, chart: Any, ode: Any, between: bool = False) -> Any:
        """The point y of the manifold at time t that u, a stage's or one `between` steps, stands for, and whether it was found."""
        return ode.retract_along(t, u, chart)

    def order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.order(terms)

    def error_order(self, terms: diffrax.AbstractTerm) -> Any:
        return self.solver.error_order(terms)

    def step_in(
        self,
        chart: Any,
        terms: diffrax.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: Any,
        args: Any,
        derivative: Any,
        made_jump: BoolLike,
    ) -> Any:
        """The step in the chart in which a point moves along `chart` on to the manifold; `derivative` is ẏ at y₀."""
        sign = time_sign(terms, t0, t1)
        solver: Any = unrolled(self.solver)

        # The end of the step is the lift of the last stage's point; its derivative is the next step's first.
        tangent_term = diffrax.ODETerm(lambda t, u, _: self._field(terms, sign, args, chart, t, u))
        first = self.along(derivative, chart, args) if made_jump is False else None
        first = tangent_term.vf(t0, y0, None) if first is None else first
        wrapped = _Controlled(tangent_term, terms)
        u1, error, dense, _, _ = solver.step_and_retract(wrapped, t0, t1, y0, None, first, False, identity)
        y1, found = self.lift(sign * t1, u1, chart, args)
        y1 = or_nan(found, y1)
        end = terms.vf(t1, y1, args)
        if error is not None:
            error = or_nan(found & ~_jumps(y0, y1, derivative, end, terms.contr(t0, t1)), error)
        info = {"inner_info": dense, "jacobian": chart}
        return y1, error, info, end, outcome(found)

    def retract(self, t: Any, y: Any, ode: Any) -> Any:
        if not isinstance(y, ChartPoint):
            return y
        y, found = self.lift(t, y.y, y.jacobian, ode, between=True)
        return or_nan(found, y)

    def whole_path(self, path: diffrax.DenseInterpolation) -> diffrax.DenseInterpolation:
        first = ChartPoint(path.y0_if_trivial, jax.tree.map(lambda x: x[0], path.infos["jacobian"]))
        return eqx.tree_at(lambda p: p.y0_if_trivial, path, first)

    def _field(self, terms: diffrax.AbstractTerm, sign: Any, ode: Any, chart: Any, t: Any, u: Any) -> Any:
        y, found = self.lift(sign * t, u, chart, ode)
        return or_nan(jnp.asarray(found), self.along(terms.vf(t, y, ode), chart, ode))


class _Controlled(eqx.Module):
    """The field in the chart with the step of the outer term. It is a large program: the stages are looped."""

    term: diffrax.ODETerm
    outer: Any
    looped: bool = eqx.field(static=True, default=True)

    def vf(self, t: Any, y: Any, args: Any) -> Any:
        return self.term.vf(t, y, args)

    def contr(self, t0: Time, t1: Any) -> Any:
        return self.outer.contr(t0, t1)


def _jumps(y0: Any, y1: Any, start: Any, end: Any, h: Any) -> Any:
    """Whether a step is much longer than the speed at its ends explains: where the manifold jumps in time, the point of the
    chart is lifted on to it all the same.
    """
    y0, y1, start, end = (ravel_pytree(x)[0] for x in (y0, y1, start, end))
    largest = lambda x: jnp.max(jnp.abs(x))
    allowed = float(jnp.finfo(y0.dtype).eps) ** 0.5 * (1 + largest(y1))
    return largest(y1 - y0) > allowed + SPEEDS * jnp.abs(h) * (largest(start) + largest(end))
