"""What a solve gives back."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Real


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """diffrax's result codes, and those of a DAE."""

    inconsistent_start = (
        "The initial state `y0` violates the constraints (position or velocity level). "
        "`dae_jax.consistent_state(system, t0, y0, args)` gives the nearest state that does not."
    )
    not_finite = (
        "The solution is not finite: the force or a constraint returned NaN or infinity, the constraints became "
        "dependent (say how many are independent by `ConstrainedSystem(..., rank=...)`), or the steps are too large for "
        "the method."
    )
    step_rejected = (
        "The step size went to the resolution of time: at the last time reached the force is not finite, the "
        "constraints become dependent (a singular configuration) or jump, or the equations do not determine all "
        "derivatives (`dae_jax.analyse` says so)."
    )
    off_manifold = (
        "The nonlinear equations of a step had no solution within reach: the step is too large for the manifold's "
        "curvature, or the constraints contradict each other or become dependent. Take smaller steps."
    )
    singular_iteration_matrix = (
        "The iteration matrix ∂F/∂y + c ∂F/∂ẏ is singular, however small the step: the equations do not determine all "
        "unknowns here. `dae_jax.analyse` shows the index and which variable each equation determines."
    )
    no_convergence = (
        "Newton's method did not converge for the equations of a step, however small: a function has a jump or a kink "
        "there, leaves its domain (NaN), or the equations have no solution beyond. For an index of 3, try a form of lower "
        "index (`Residual('index-2')`, `GGL()`) or another method."
    )
    error_too_large = (
        "The error of a step stayed above the tolerance, however small the step: the solution is not smooth there, grows "
        "without bound, or the tolerance is below round-off. Try a larger `atol`, a lower index (`dae_jax.analyse` shows "
        "it), or another method."
    )
    too_many_jumps = (
        "There were more jumps than `Jump(most=...)` allows: raise it, or look whether the jumps pile up at one time, as "
        "those of a ball that comes to rest do."
    )


class Interpolation(eqx.Module):
    """The solution at any time, in the user's structure, on the manifold where the method keeps its steps there."""

    path: diffrax.DenseInterpolation
    decode: Callable[..., Any]
    ode: Any

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        """The state at `t0`, or its increment from `t0` to `t1`."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0, left=left), self.evaluate(t1, left=left))
        return self.decode(t0, self.path.evaluate(t0, left=left), self.ode)


class DAESolution(eqx.Module):
    """The solution of a DAE; the fields are those of `diffrax.Solution`.

    - `t0`, `t1`: the interval.
    - `ts`: the saved times; `ys`: the saved states, with the structure of `y0` (or of what `SaveAt(fn=...)` returns).
    - `interpolation`: with `SaveAt(dense=True)`, the solution at any time; `sol.evaluate(t)` for short.
    - `stats`: counts of steps; of a solve outside `jit`, `vmap` and `grad` also "compile_seconds", the time that it took to
      trace and compile it and to run it for the first time, 0 where it was compiled already.
    - `result`: a `RESULTS` code, with its message.
    - `event_mask`: which event ended the solve, if any.
    - `rank`: how many constraints are independent, where some are redundant, else `None`.
    """

    t0: Any
    t1: Any
    ts: Real[Array, " times"] | Any
    ys: Any
    interpolation: Interpolation | None
    stats: dict[str, Any]
    result: Any
    event_mask: Any
    args: Any = None
    rank: int | None = eqx.field(static=True, default=None)

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        """The state at any time, where `SaveAt(dense=True)` was asked for."""
        if self.interpolation is None:
            raise ValueError("The solution has no dense output; pass `saveat=diffrax.SaveAt(dense=True)`.")
        return self.interpolation.evaluate(t0, t1, left)


def all_finite(ts: Any, ys: Any) -> Any:
    """Whether every saved state is finite; times that are not finite are padding."""
    saved = jnp.isfinite(ts)
    finite = [
        jnp.all(jnp.isfinite(y).reshape(y.shape[0], -1), axis=1)
        for y in jax.tree.leaves(ys)
        if jnp.issubdtype(y.dtype, jnp.inexact)
    ]
    return jnp.all(jnp.stack([jnp.all(f | ~saved) for f in finite])) if finite else jnp.asarray(True)
