"""How good Baumgarte's α and β are, as a smooth function of both: the loss to tune them by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .formulations import Baumgarte
from .solution import RESULTS
from .solve import daesolve
from .solvers import DOP853, OrthogonalProjection
from .systems import ConstrainedSystem


# The loss of a solve that fails: above all that a solve which succeeds can have.
FAILED = 50.0
# What is below is round-off; a logarithm needs a floor.
FLOOR = 1e-16
# The error of a method with one step size can be zero by accident, for some α and β; with three of them at once it is not.
STEP_RATIOS = (1.0, 0.87, 0.76)


class Parts(NamedTuple):
    """What a `BaumgarteLoss` weighs: `drift`, `error` (root mean squares), `stiffness` (h ρ), and the solve's `result`."""

    drift: Float[Array, ""]
    error: Float[Array, ""]
    stiffness: Float[Array, ""]
    result: Any


class Verification(NamedTuple):
    """Largest deviations from the reference over the times of the loss, each by a solve that the loss did not use.

    - `tight`: adaptive steps at rtol 1e-11: what remains is the formulation's own, and should be round-off.
    - `at_dt0`, `at_half_dt0`: Tsit5 or the given solver with the steps dt0 and dt0/2; a real optimum falls with the
      method's order, an accident does not.
    """

    tight: float
    at_dt0: float
    at_half_dt0: float


class BaumgarteLoss(eqx.Module):
    """See `baumgarte_loss`. Called with {"alpha": α, "beta": β} it gives the loss."""

    system: ConstrainedSystem
    y0: Any
    args: Any
    times: Float[Array, " times"]
    dt0: Float[Array, ""]
    reference: Any
    solver: diffrax.AbstractSolver
    weights: tuple[float, float, float] = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def __call__(self, params: dict[str, Any]) -> Float[Array, ""]:
        drift, error, stiffness, result = self.parts(params)
        of_drift, of_error, of_cost = self.weights
        # Where a solve failed, zeros go through the logarithms, so that no NaN reaches a derivative.
        okay = result == RESULTS.successful
        decades = [jnp.log10(FLOOR + jnp.where(okay, x, 1.0)) for x in (drift, error)]
        value = of_drift * decades[0] + of_error * decades[1] + of_cost * stiffness
        # A failure is no plateau: its slope leads back to smaller parameters.
        return jnp.where(okay & (value < FAILED), value, FAILED + of_cost * jnp.log1p(stiffness))

    def parts(self, params: dict[str, Any]) -> Parts:
        """Drift, error and stiffness at {"alpha": α, "beta": β}; NaN or infinite where a solve failed."""
        found = [self._fixed(params, ratio * self.dt0) for ratio in STEP_RATIOS]
        drift, error = (
            jnp.sqrt(sum(squares) / len(found)) for squares in zip(*(f[:2] for f in found), strict=True)
        )
        failed = [f[2] for f in found]
        result = failed[0]
        for other in failed[1:]:
            result = RESULTS.where(result == RESULTS.successful, other, result)
        rate = jnp.sqrt(4 * params["alpha"] ** 2 + 2 * params["beta"] ** 2)
        return Parts(drift, error, self.dt0 * rate, result)

    def verify(self, params: dict[str, Any]) -> Verification:
        """Independent solves at {"alpha": α, "beta": β}."""
        controller = diffrax.PIDController(rtol=1e-11, atol=1e-11)
        tight = self._solve(params, DOP853(), None, 10_000_000, stepsize_controller=controller, throw=True)
        coarse, fine = (
            self._solve(params, self.solver, float(h), 4 * self.max_steps, throw=True) for h in (self.dt0, self.dt0 / 2)
        )
        return Verification(*(_largest(sol.ys, self.reference) for sol in (tight, coarse, fine)))

    def _fixed(self, params: dict[str, Any], h: Any) -> tuple[Any, Any, Any]:
        sol = self._solve(params, self.solver, h, self.max_steps, throw=False)
        violations = jax.vmap(self._violations)(self.times, *sol.ys)
        differences = jax.tree.map(lambda y, r: jnp.sum((y - r) ** 2), sol.ys, self.reference)
        numbers = sum(leaf.size for leaf in jax.tree.leaves(self.reference))
        return jnp.mean(violations**2), sum(jax.tree.leaves(differences)) / numbers, sol.result

    def _violations(self, t: Any, q: Any, v: Any) -> Any:
        found = []
        if self.system.constraint is not None:
            found.append(jnp.ravel(self.system.constraint(t, q, self.args)))
        if self.system.nonholonomic is not None:
            found.append(jnp.ravel(self.system.nonholonomic(t, q, v, self.args)))
        return jnp.concatenate(found)

    def _solve(self, params: dict[str, Any], solver: Any, h: Any, max_steps: int, **options: Any) -> Any:
        return daesolve(
            self.system, solver, 0.0, self.times[-1], h, self.y0, self.args,
            formulation=Baumgarte(params["alpha"], params["beta"]), saveat=diffrax.SaveAt(ts=self.times),
            adjoint=diffrax.ForwardMode(), max_steps=max_steps, **options,
        )  # fmt: skip


def baumgarte_loss(
    system: ConstrainedSystem,
    y0: Any,
    t1: float,
    *,
    dt0: float,
    args: Any = None,
    solver: diffrax.AbstractSolver = diffrax.Tsit5(),  # noqa: B008
    reference: Callable[[np.ndarray], Any] | None = None,
    weights: tuple[float, float, float] = (1.0, 1.0, 1.0),
    times: int = 100,
) -> BaumgarteLoss:
    """The loss to choose Baumgarte's parameters by, for a solve from 0 to `t1` with fixed steps of `dt0`:

        L(α, β) = w₁ log₁₀ D + w₂ log₁₀ E + w₃ dt0 ρ,

    - D: the drift, the root mean square of g (and h) over the solution at `times` times;
    - E: the error, the root mean square of (q, v) minus the reference at the same times;
    - dt0 ρ, ρ² = 4α² + 2β²: the stiffness that the parameters bring. ρ is the Frobenius norm of [[0, β], [−β, −2α]], whose
      eigenvalues are the rates s of the feedback, s² + 2αs + β² = 0, so ρ ≥ |s|; an explicit method is stable up to
      about dt0 |s| = 3.

    So a decade of drift, a decade of error and a third of the stable range weigh alike, by default.

    The best α and β belong to a step size, and the loss is smooth for a given one; adaptive steps would add noise. At a
    single step size the error can vanish by accident; D and E are therefore taken over three solves, with steps of 1, 0.87
    and 0.76 dt0. A solve that fails has the loss 50 + w₃ log(1 + dt0 ρ), above all others.

    **Arguments**

    - `system`, `y0`, `args`, `solver`: as in `daesolve`. `solver` takes steps of `dt0`.
    - `reference`: a function of an array of times to (q, v) with a leading axis of times; by default a solve by
      orthogonal projection at rtol 1e-12, which depends on neither α nor β.
    - `weights`: (w₁, w₂, w₃).

    **Returns** a function of {"alpha": α, "beta": β} for `tune` and `sweep`, differentiable in forward mode; its method
    `parts` gives D, E and dt0 ρ, its method `verify` independent solves.

    Errors: `ValueError` for a step that is not positive or a reference of another shape; `RuntimeError` where the
    reference cannot be solved for.

    Source: U. M. Ascher, H. Chin, L. R. Petzold, S. Reich, *Stabilization of constrained mechanical systems with DAEs and
    invariant manifolds*, J. Struct. Mech. 23 (1995), on the parameters' dependence on the step size.
    """
    if not (np.isfinite(dt0) and np.isfinite(t1) and 0 < dt0 <= t1):
        raise ValueError(f"`dt0` and `t1` must satisfy 0 < dt0 ≤ t1, but are {dt0} and {t1}.")
    y0 = jax.tree.map(jnp.asarray, tuple(y0))
    saved = jnp.linspace(0, t1, times + 1, dtype=jnp.result_type(*jax.tree.leaves(y0)))[1:]
    if reference is None:
        rtol = 1e-12 if saved.dtype == jnp.float64 else 1e-6
        truth = daesolve(
            system, OrthogonalProjection(DOP853()), 0.0, saved[-1], None, y0, args, saveat=diffrax.SaveAt(ts=saved),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), max_steps=10_000_000,
        ).ys  # fmt: skip
    else:
        truth = jax.tree.map(lambda x: jnp.asarray(x, saved.dtype), tuple(reference(np.asarray(saved))))
    expected = jax.tree.map(lambda x: (times, *x.shape), y0)
    found = jax.tree.map(jnp.shape, truth)
    if found != expected:
        raise ValueError(f"`reference` must give (q, v) of shapes {expected}, but gives {found}.")
    max_steps = int(np.ceil(t1 / (min(STEP_RATIOS) * dt0))) + 16
    return BaumgarteLoss(
        system, y0, args, saved, jnp.asarray(dt0, saved.dtype), truth, solver, tuple(map(float, weights)), max_steps
    )


def _largest(a: Any, b: Any) -> float:
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
