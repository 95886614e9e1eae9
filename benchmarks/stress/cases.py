"""What is solved, by what, and what must come out."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import numpy as np

import dae_jax as dj


@dataclasses.dataclass(frozen=True)
class Method:
    """A formulation and a solver; `order` where its steps are fixed. The formulation "chart" is `StateSpace` in the case's."""

    solver: Any
    formulation: Any = None
    order: int | None = None


METHODS = {
    "projection-tsit5": Method(dj.OrthogonalProjection(diffrax.Tsit5())),
    "projection-dop853": Method(dj.OrthogonalProjection(dj.DOP853())),
    "tangent-space": Method(dj.TangentSpace(diffrax.Tsit5())),
    "state-space": Method(dj.DOP853(), "chart"),
    "baumgarte": Method(dj.DOP853(), dj.Baumgarte(20.0, 20.0)),
    "differentiation": Method(dj.DOP853()),
    "dummy-dop853": Method(dj.DOP853(), dj.DummyDerivatives()),
    "dummy-radau": Method(dj.RadauIIA5(), dj.DummyDerivatives()),
    "dummy-bdf": Method(dj.BDF(), dj.DummyDerivatives()),
    "radau-ggl": Method(dj.RadauIIA5(), dj.GGL()),
    "radau-variable-ggl": Method(dj.Radau(), dj.GGL()),
    "radau-index-2": Method(dj.RadauIIA5(), dj.Residual("index-2")),
    "radau-index-3": Method(dj.RadauIIA5(), dj.Residual("index-3")),
    "bdf-ggl": Method(dj.BDF(), dj.GGL()),
    "symmetric-trapezoid": Method(dj.SymmetricProjection(dj.Trapezoid()), order=2),
    "symmetric-gauss4": Method(dj.SymmetricProjection(dj.Gauss4()), order=4),
    "rattle": Method(dj.RATTLE(), order=2),
}
# These promise the constraints to round-off.
ON_THE_CONSTRAINTS = (
    "projection-tsit5",
    "projection-dop853",
    "tangent-space",
    "dummy-dop853",
    "dummy-radau",
    "dummy-bdf",
)
# These promise an energy without a trend.
SYMMETRIC = ("symmetric-trapezoid", "symmetric-gauss4", "rattle")


@dataclasses.dataclass(frozen=True)
class Case:
    """One stressor.

    - `name`; `system`, `y0`, `args`; `t1` in s.
    - `truth(times)`: (q, v) at these times, not from this library; `or_else`: more of them, where the equations have several solutions.
    - `size`: of positions and of velocities, numbers or arrays like q: errors and drift are relative to it.
    - `rtol`; the absolute tolerance is `rtol` times the smallest size, at most 1; with `tolerance_each`, of each unknown, times its size.
    - `steps`, `rate`: of methods with fixed steps, how many, and the angular frequency that they must resolve, in 1/s.
    - `chart`: for the state-space form.
    - `due`: what must happen: an "answer", a "refusal", a "failure" (at the time `ends`), "words" (either of them, at any time)
      or "any" of all that, an answer only if it is right.
    - `times`: how many to compare at; `energy(q, v)`: where its growth and that of errors are recorded.
    - `only`: the methods that it is for; by default all. `fixed`: fixed steps for all of them.
    - `off`: by how much the start is off, as a part of the sizes. `bound`: the error that is allowed, in place of the rule.
    - `formulation`: in place of the method's. `lasting`: so long that a tolerance, which is for a step, says little of the end.
    """

    name: str
    system: Any
    y0: Any
    t1: float
    truth: Callable[[np.ndarray], Any]
    args: Any = None
    size: tuple[Any, Any] = (1.0, 1.0)
    rtol: float = 1e-8
    tolerance_each: bool = False
    steps: int = 1000
    rate: float = 1.0
    chart: Callable[..., Any] | None = None
    due: str = "answer"
    ends: float = np.inf
    times: int = 21
    energy: Callable[..., Any] | None = None
    only: tuple[str, ...] = ()
    or_else: tuple[Callable[[np.ndarray], Any], ...] = ()
    fixed: bool = False
    off: float = 0.0
    bound: float | None = None
    formulation: Any = None
    max_steps: int = 100_000
    lasting: bool = False

    def applies(self, name: str) -> bool:
        """Whether the method of this name is for it."""
        chartless = METHODS[name].formulation == "chart" and self.chart is None
        return not chartless and (not self.only or name in self.only)

    def allowed(self, method: Method) -> float:
        """The error of an `ok` cell: a thousand tolerances; of fixed steps ten times what their order says, (ω h)^p a radian."""
        if self.bound is not None:
            return self.bound
        if method.order is None:
            return min(1e3 * self.rtol, 0.1) + 10 * self.off
        phase = self.rate * abs(self.t1)
        rounding = 1e4 * float(np.finfo(self.y0[0].dtype).eps)
        return float(np.clip(10 * (1 + phase) * (phase / self.steps) ** method.order, rounding, 0.1)) + 10 * self.off
