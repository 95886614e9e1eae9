"""How good Baumgarte's α and β are, as a smooth function of both: the loss to tune them by."""

import dataclasses
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiler import at_ease
from ..formulations import Baumgarte
from ..solution import RESULTS, DAESolution
from ..solve import daesolve
from ..solvers import DOP853, OrthogonalProjection
from ..systems import ConstrainedSystem, is_mechanism
from ..types import Args, IntScalar, Solver, State, Time
from ..validate.states import refuse_no_time, refuse_wrong_system


# The loss of a solve that fails: above all that a solve which succeeds can have.
FAILED = 50.0
# What is below is round-off; a logarithm needs a floor.
FLOOR = 1e-16
# The interval is solved in so many windows, each half as long and started on the reference. From a single start the error
# can vanish by accident, for some α and β and all steps; from several at once it does not.
WINDOWS = 4


class Parts(NamedTuple):
    """What a `BaumgarteLoss` weighs: `drift`, `error` (root mean squares), `stiffness` (dt0 ρ), and the solves' `result`."""

    drift: Float[Array, ""]
    error: Float[Array, ""]
    stiffness: Float[Array, ""]
    result: Any


class Deviation(NamedTuple):
    """Root mean squares of (q, v) minus the reference, and of g (and h); infinite where the solve failed."""

    error: float
    drift: float


class Verification(NamedTuple):
    """Solves that the loss does not use: of the whole interval at once.

    - `tight`: adaptive steps of DOP853 at rtol 1e-11: the formulation itself, apart from any step size.
    - `at_dt0`, `at_half_dt0`: the loss's solver with steps of dt0 and dt0/2.
    """

    tight: Deviation
    at_dt0: Deviation
    at_half_dt0: Deviation


@dataclasses.dataclass(frozen=True, eq=False)
class BaumgarteLoss:
    """See `baumgarte_loss`. Called with {"alpha": α, "beta": β} it gives the loss."""

    system: ConstrainedSystem = dataclasses.field(repr=False)
    y0: Any
    args: Any
    times: Float[np.ndarray, " times"] = dataclasses.field(repr=False)
    dt0: float
    reference: Any = dataclasses.field(repr=False)
    solver: Solver
    weights: tuple[float, float, float]

    def __call__(self, params: dict[str, Any]) -> Float[Array, ""]:
        if set(params) != {"alpha", "beta"}:
            raise ValueError(
                f'The parameters must be {{"alpha": α, "beta": β}}, but are {", ".join(map(repr, params))}.'
            )
        return _by_forward_mode(self._value)({k: jnp.asarray(x, jnp.result_type(x, float)) for k, x in params.items()})

    def _value(self, params: dict[str, Any]) -> Float[Array, ""]:
        drift, error, stiffness, result = self.parts(params)
        of_drift, of_error, of_cost = self.weights
        # Where a solve failed, ones go through the logarithms, so that no NaN reaches a derivative.
        okay = result == RESULTS.successful
        decades = [jnp.log10(FLOOR + jnp.where(okay, x, 1.0)) for x in (drift, error)]
        value = of_drift * decades[0] + of_error * decades[1] + of_cost * stiffness
        # A failure is no plateau: its slope leads back to smaller parameters.
        return jnp.where(okay & (value < FAILED), value, FAILED + of_cost * jnp.log1p(stiffness))

    def parts(self, params: dict[str, Any]) -> Parts:
        """Drift, error and stiffness at {"alpha": α, "beta": β}; not finite where a solve failed. They have forward derivatives."""
        times = len(self.times) - 1
        length = times // 2
        firsts = np.arange(WINDOWS) * (times - length) // (WINDOWS - 1)
        drifts, errors, results = jax.lax.map(lambda i: self._window(params, i, length), jnp.asarray(firsts))
        code: Any = RESULTS.successful
        for w in range(WINDOWS):
            code = RESULTS.where(code == RESULTS.successful, jax.tree.map(operator.itemgetter(w), results), code)
        rate = jnp.sqrt(4 * params["alpha"] ** 2 + 2 * params["beta"] ** 2)
        return Parts(jnp.sqrt(jnp.mean(drifts)), jnp.sqrt(jnp.mean(errors)), self.dt0 * rate, code)

    def verify(self, params: dict[str, Any]) -> Verification:
        """Independent solves at {"alpha": α, "beta": β}, once from the start to the end."""
        controller = diffrax.PIDController(rtol=1e-11, atol=1e-11)
        tight = self._solve(params, DOP853(), None, self.y0, self.times, 10_000_000, stepsize_controller=controller)
        fixed = [
            self._solve(params, self.solver, h, self.y0, self.times, self._steps(self.times[-1], h))
            for h in (self.dt0, self.dt0 / 2)
        ]
        return Verification(*map(self._deviation, (tight, *fixed)))

    def _window(self, params: dict[str, Any], first: IntScalar, length: int) -> tuple[Any, Any, Any]:
        """Mean squares of drift and error over the times after the first, and the result."""
        times, reference = jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(jnp.asarray(x), first, length + 1), (self.times, self.reference)
        )
        start = jax.tree.map(lambda x: x[0], reference)
        sol = self._solve(params, self.solver, self.dt0, start, times, self._steps(self.times[length], self.dt0))
        return *self._mean_squares(times, sol.ys, reference), sol.result

    def _deviation(self, sol: DAESolution) -> Deviation:
        if sol.result != RESULTS.successful:
            return Deviation(np.inf, np.inf)
        drift, error = self._mean_squares(jnp.asarray(self.times), sol.ys, self.reference)
        return Deviation(float(error) ** 0.5, float(drift) ** 0.5)

    def _mean_squares(self, times: Array | np.ndarray, ys: State, reference: State) -> tuple[Any, Any]:
        """Of the violations and of the errors, without the start, where both are zero."""
        violations = jax.vmap(self._violations)(times[1:], *jax.tree.map(lambda y: y[1:], ys))
        pairs = zip(jax.tree.leaves(ys), jax.tree.leaves(reference), strict=True)
        differences = jnp.concatenate([jnp.ravel(y[1:] - r[1:]) for y, r in pairs])
        return jnp.mean(violations**2), jnp.mean(differences**2)

    def _violations(self, t: Time, q: State, v: State) -> Any:
        found = []
        if self.system.constraint is not None:
            found.append(jnp.ravel(self.system.constraint(t, q, self.args)))
        if self.system.nonholonomic is not None:
            found.append(jnp.ravel(self.system.nonholonomic(t, q, v, self.args)))
        return jnp.concatenate(found)

    def _solve(
        self,
        params: dict[str, Any],
        solver: Solver,
        h: Time | None,
        y0: State,
        times: Array | np.ndarray,
        max_steps: int,
        **options: Any,
    ) -> Any:
        return daesolve(
            self.system, solver, times[0], times[-1], h, y0, self.args,
            formulation=Baumgarte(params["alpha"], params["beta"]), saveat=diffrax.SaveAt(ts=cast(Array, times)),
            adjoint=diffrax.ForwardMode(), max_steps=max_steps, throw=False, **options,
        )  # fmt: skip

    @staticmethod
    def _steps(duration: Time, h: float) -> int:
        return int(np.ceil(float(cast(float, duration)) / h)) + 16


def _by_forward_mode(f: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    """A number as a function of few others, with derivatives of both modes, which are both found forwards: of two parameters that is
    cheaper than to go back over a solve, and needs no memory.
    """
    value = jax.custom_jvp(f)

    @value.defjvp
    def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        gradient, found = jax.jacfwd(lambda params: (f(params),) * 2, has_aux=True)(*primals)
        return found, sum(gradient[k] * x for k, x in tangents[0].items())

    return value


@at_ease
def baumgarte_loss(
    system: ConstrainedSystem,
    y0: State,
    t1: float,
    *,
    dt0: float,
    args: Args = None,
    solver: Solver = diffrax.Tsit5(),  # noqa: B008
    reference: Callable[[np.ndarray], Any] | None = None,
    weights: tuple[float, float, float] = (1.0, 1.0, 1.0),
    times: int = 100,
) -> BaumgarteLoss:
    """The loss to choose Baumgarte's parameters by, for a solve from 0 to `t1` with fixed steps of `dt0`:

        L(α, β) = w₁ log₁₀ D + w₂ log₁₀ E + w₃ dt0 ρ,

    - D: the drift, the root mean square of g (and h);
    - E: the error, the root mean square of (q, v) minus the reference;
    - dt0 ρ, ρ² = 4α² + 2β²: the stiffness that the parameters bring. ρ is the Frobenius norm of [[0, β], [−β, −2α]], whose
      eigenvalues are the rates s of the feedback, s² + 2αs + β² = 0, so ρ ≥ |s|; an explicit method is stable up to
      about dt0 |s| = 3.

    So a decade of drift, a decade of error and a third of the stable range weigh alike, by default. D and E are taken
    over four overlapping windows of half the interval, each started on the reference: from one start alone the error
    vanishes by accident on a curve in the (α, β) plane.

    The best α and β belong to a step size, and the loss is smooth for a given one; adaptive steps would add noise. A
    solve that fails has the loss 50 + w₃ log(1 + dt0 ρ), above all others.

    **Arguments**

    - `system`, `y0`, `args`, `solver`: as in `daesolve`. `solver` takes steps of `dt0`.
    - `reference`: a function of an array of times to (q, v) with a leading axis of times; by default a solve by
      orthogonal projection at rtol 1e-12, which depends on neither α nor β.
    - `weights`: (w₁, w₂, w₃).

    **Returns** a function of {"alpha": α, "beta": β} for `tune` and `sweep`, differentiable in both modes; its method
    `parts` gives D, E and dt0 ρ, its method `verify` independent solves.

    Errors: `ValueError` for a system that is no mechanism, a step that is not positive, or a reference of another shape or
    not finite; `RuntimeError` where the reference cannot be solved for.

    Source: U. M. Ascher, H. Chin, L. R. Petzold, S. Reich, *Stabilization of constrained mechanical systems with DAEs and
    invariant manifolds*, J. Struct. Mech. 23 (1995), on the parameters' dependence on the step size.
    """
    refuse_wrong_system(system)
    if not is_mechanism(system):
        raise ValueError(f"`baumgarte_loss` takes a ConstrainedSystem, but `system` is a {type(system).__name__}.")
    for name, value in (("dt0", dt0), ("t1", t1)):
        refuse_no_time(name, value)
    if not 0 < dt0 <= t1:
        raise ValueError(f"`dt0` and `t1` must satisfy 0 < dt0 ≤ t1, but are {dt0} and {t1}.")
    if not isinstance(times, int | np.integer) or times < 2 * WINDOWS:
        raise ValueError(f"`times` must be at least {2 * WINDOWS}, a whole number, but is {times!r}.")
    if np.shape(weights) != (3,) or not np.all(np.isfinite(weights)):
        raise ValueError(f"`weights` must be three finite numbers, of drift, error and stiffness, but is {weights}.")
    y0 = jax.tree.map(jnp.asarray, tuple(y0))
    saved = np.linspace(0, t1, times + 1, dtype=jnp.result_type(*jax.tree.leaves(y0)))
    if reference is None:
        rtol = 1e-12 if saved.dtype == jnp.float64 else 1e-6
        truth = daesolve(
            system, OrthogonalProjection(DOP853()), 0.0, saved[-1], None, y0, args, saveat=diffrax.SaveAt(ts=cast(Array, saved)),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), max_steps=10_000_000,
        ).ys  # fmt: skip
    else:
        truth = jax.tree.map(lambda x: np.asarray(x, saved.dtype), tuple(reference(saved)))
    expected = jax.tree.map(lambda x: (times + 1, *x.shape), y0)
    found = jax.tree.map(jnp.shape, truth)
    if found != expected:
        raise ValueError(f"`reference` must give (q, v) of shapes {expected}, but gives {found}.")
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(truth)):
        raise ValueError("`reference` must be finite at every time, but is not; leave it out to have it solved for.")
    of_drift, of_error, of_cost = map(float, weights)
    truth = jax.tree.map(np.asarray, truth)
    return BaumgarteLoss(system, y0, args, saved, float(dt0), truth, solver, (of_drift, of_error, of_cost))
