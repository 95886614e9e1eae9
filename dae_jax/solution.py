"""What a solve gives back."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree, Real

from ._compat import messages
from .compiler import at_ease, quickly_compiled
from .tables import table
from .types import Args, BoolScalar, DType, State, Time


# What shows a solution lies on a floor above: the package registers it here, by name.
VIEWS: dict[str, Callable[..., Any]] = {}


class AccuracyWarning(UserWarning):
    """A solve that went well, with an answer that may be off by more than was asked for."""


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """diffrax's result codes, and those of a DAE."""

    inconsistent_start = (
        "The initial state `y0` violates the equations or the hidden constraints (of a mechanism: at position or velocity level). "
        "`dae_jax.consistent_state(system, t0, y0, args)` gives the nearest state that does not."
    )
    ambiguous_start = (
        "The equations are nonlinear in ẏ, and several ẏ satisfy them at the start: say which by `yd0`, ẏ at the start or "
        "near it."
    )
    dependent_constraints = (
        "The constraints depend on each other at the start, or not as many are independent as `rank` says: a gradient "
        "vanishes (write the constraint itself, not its square), the start is a singular configuration, or constraints are "
        "redundant. Where these agree say how many are independent by `ConstrainedSystem(..., rank=...)`: with a start that "
        "is traced (`jit`, `vmap`) it is not found."
    )
    irregular_mass = (
        "The mass matrix is not symmetric and positive definite, at the start or where the solve ended. A massless "
        "coordinate is for RadauIIA5() or BDF() with GGL() or Residual(...), and for DummyDerivatives()."
    )
    singular_configuration = (
        "The constraints become dependent where the solve ended: a singular configuration, such as a dead centre or a "
        "linkage at the end of its reach, beyond which the motion does not exist or is not determined. Stop before it "
        "(`event`), or change what drives it there."
    )
    off_constraints = (
        "The solution does not satisfy the constraints at its end: it has drifted off by as much as its own size, "
        "the chart of `StateSpace` leaves them, constraints that were redundant contradict each other, or one has become singular. "
        "Use a method that keeps the constraints, such as OrthogonalProjection, and smaller steps or tolerances; `dae_jax.drift` "
        "shows where."
    )
    no_finite_start = (
        "The start does not determine all unknowns: the gradient of a constraint vanishes there (write the constraint itself, not "
        "its square), equations depend on each other, a function is not finite, or the chart of `StateSpace` does not give the "
        "initial positions (it must satisfy the constraints for every z; near a fold give `guess`)."
    )
    not_finite = (
        "The solution is not finite: the force, the mass matrix or a constraint returned NaN or infinity, a mass became "
        "negative, the constraints became dependent, or the steps are too large for the method, or to tell the roots of an "
        "algebraic equation apart (smaller tolerances)."
    )
    times_outside = (
        "A time to save at (`saveat.ts`) lies outside of t0 to t1, if only by round-off: nothing is known there. Make t1 the last "
        "of these times. Or they are not in the order in which the solve passes them, or one is NaN."
    )
    undefined_interval = "`t0` or `t1` is NaN or infinite: there is nothing to solve over."
    undefined_formulation = (
        "`alpha` of Baumgarte is negative, with which the error of a constraint grows without bound, or `alpha` or `beta` "
        "is NaN."
    )
    undefined_condition = (
        "The condition of an event is not a number (NaN) where the solve ended: an event there is not seen. Let it be defined "
        "on either side of its zero."
    )
    event_not_located = (
        "An event occurred, and its root finder did not find out when: it starts at the end of the step, from where Newton's method "
        "may lead away. Use `diffrax.Event(condition, optimistix.Bisection(rtol, atol, flip='detect'))`."
    )
    step_rejected = (
        "The step size went to the resolution of time: at the last time reached the force is not finite, the "
        "constraints become dependent (a singular configuration), contradict each other or jump, or the equations do not "
        "determine all derivatives (`dae_jax.analyse` says so)."
    )
    off_manifold = (
        "The nonlinear equations of a step had no solution within reach: the step is too large for the manifold's "
        "curvature, or the constraints contradict each other or become dependent. Take smaller steps."
    )
    singular_iteration_matrix = (
        "The iteration matrix ∂F/∂y + c ∂F/∂ẏ is singular, however small the step: the equations do not determine all "
        "unknowns here. `dae_jax.analyse` shows the index and which variable each equation determines. (With "
        "`linear_solver=GMRES(...)`, where that does not converge too: a better preconditioner, more products, `most`.)"
    )
    undetermined = (
        "On its way the solution has passed states at which the equations do not determine all unknowns: the matrix of their highest "
        "derivatives is singular to round-off, and what it leaves open could be any number there. `dae_jax.analyse` shows which "
        "variable each equation determines."
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
        "There were more resets than `Reset(max_resets=...)` allows: raise it, or look whether they pile up at one time, as "
        "those of a ball that comes to rest do."
    )
    inconsistent_reset = (
        "The state after a reset cannot be made consistent: near what the `reset` of `Reset(condition, reset)` gave, no "
        "state was found that satisfies the equations and the hidden constraints with the `args` after it. The equations "
        "may contradict each other from here on, too many entries may be `fixed`, or a number is not finite."
    )
    undetermined_side = (
        "The condition of a Reset is zero at the start, or after a reset, stays there for a while, and is not zero at the end: it "
        "was not seen to which side it went, nor whether it came back. Say which crossings count: "
        "`Reset(condition, reset, direction=True)` (upwards) or `direction=False`."
    )


# A success says so where it is printed.
messages(RESULTS)[int(RESULTS.successful._value)] = "successful"


@functools.partial(jax.tree_util.register_dataclass, data_fields=("numbers",), meta_fields=("rest",))
@dataclasses.dataclass(frozen=True)
class Split:
    """What a jitted function returns: its arrays, and the rest."""

    numbers: Any
    rest: Any

    @classmethod
    def of(cls, tree: PyTree) -> "Split":
        return cls(*eqx.partition(tree, eqx.is_array))

    @classmethod
    def to_return(cls, tree: PyTree) -> "Split":
        """Of a part of a solution, which the user may return to `jit`: numpy's arrays have no hash."""
        return cls(*eqx.partition(tree, lambda x: isinstance(x, jax.Array | np.ndarray | np.generic)))

    def whole(self) -> Any:
        """The two together."""
        return eqx.combine(self.numbers, self.rest)


class Interpolation(eqx.Module):
    """The solution at any time, in the user's structure, on the manifold where the method keeps its steps there."""

    path: diffrax.DenseInterpolation
    # What makes states of points, and its `ode`.
    view: Split

    @classmethod
    def of(cls, path: diffrax.DenseInterpolation, decode: Callable[..., Any], ode: Any) -> "Interpolation":
        return cls(path, Split.to_return((decode, ode)))

    @at_ease
    def evaluate(self, t0: Time, t1: Time | None = None, left: bool = True) -> Any:
        """The state at `t0`, or its increment from `t0` to `t1`."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0, left=left), self.evaluate(t1, left=left))
        decode, ode = self.view.whole()
        return decode.between(self.path, t0, left, ode)


class DAESolution(eqx.Module):
    """The solution of a DAE; the fields are those of `diffrax.Solution`.

    - `t0`, `t1`: the interval.
    - `ts`: the saved times; `ys`: the saved states, with the structure of `y0` (or of what `SaveAt(fn=...)` returns).
    - `interpolation`: with `SaveAt(dense=True)`, the solution at any time; `sol.evaluate(t)` for short.
    - `stats`: counts of steps, of Radau and BDF also "num_jacobians", "num_factorisations" and "num_corrections" (of Newton's method)
      in the accepted ones; `stats["end_time"]`: the time at which the solve ended; of a solve outside `jit`, `vmap` and
      `grad` also "compile_seconds", the time that it took to trace and compile it and to run it for the first time, 0 where it
      was compiled already; `stats["doubts"]`: 0, or what an `AccuracyWarning` says, as the sum of 1 (drifted), 2 (fixed steps too
      large), 4 (very many steps), 8 (a singular configuration was passed) and 16 (a pulse in time may have been stepped over).
    - `result`: a `RESULTS` code, with its message.
    - `event_mask`: which event ended the solve, if any.
    - `args`: as given; `changed`: what the resets of a `Reset` have changed of them, in their structure, as it holds at each saved time
      (a leading axis), `None` for the rest.
    - `end`: the time and the state (t, y) at which the solve ended, saved or not, also where it failed; without derivatives.
    - `rank`: how many constraints are independent, where some are redundant, else `None`.
    - `precision`: with how many digits it was computed, and the tolerances: "float32, rtol 1e-05, atol 1e-05".
    """

    t0: Any
    t1: Any
    ts: Real[Array, " times"] | Any
    ys: Any
    interpolation: Interpolation | None
    stats: dict[str, Any]
    result: Any
    event_mask: Any
    given: Any = eqx.field(
        converter=lambda args: args if isinstance(args, Split) else Split.to_return(args), default=None
    )
    rank: int | None = eqx.field(static=True, default=None)
    precision: str = eqx.field(static=True, default="")
    changed: Any = None
    end: Any = None

    @property
    def args(self) -> Any:
        """As they were given to the solve."""
        return self.given.whole()

    @property
    def final(self) -> Any:
        """The last saved state, to go on from with `y0=sol.final`; of each part of `SaveAt(subs=...)` where there are any.
        Infinite where nothing was saved. Of a batch of solutions, the last state of each.

        Errors: `ValueError` where the solve was to save nothing.
        """
        if self.ts is None:
            raise ValueError("The solution has no saved states; pass `saveat=diffrax.SaveAt(t1=True)`.")
        return jax.tree.map(_last, self.ts, self.ys)

    def evaluate(self, t0: Time, t1: Time | None = None, left: bool = True) -> Any:
        """The state at any time, where `SaveAt(dense=True)` was asked for. At a time in `jump_ts` it is that on the side where the solve
        comes from, with `left=False` that on the other. Its derivative by the time is ẏ there, by the equations, as are those by times
        of events; by `RadauIIA5`, `BDF` and other solvers of residuals with more than 256 unknowns the slope of what is between steps,
        of a lower order than the state (of tolerance 1e-8 about 1e-5 off), as are those by times of `SaveAt(ts=...)`.
        """
        if self.interpolation is None:
            raise ValueError("The solution has no dense output; pass `saveat=diffrax.SaveAt(dense=True)`.")
        return self.interpolation.evaluate(t0, t1, left)

    def animate(self, what: object, **options: object) -> Any:
        """The solution as a moving mechanism: `what` is a scene, a `scenes.Drawing` or a function points(t, q), the options are
        those of `plotting.animate`. A notebook shows what it gives, and `.save("pendulum.html")`, .gif or .mp4 writes it.

        Errors: those of `plotting.animate`.
        """
        return VIEWS["animate"](what, self, **options)

    def __repr__(self) -> str:
        """As of any module; of a batch how many solves were successful in place of a sentence for each."""
        value = getattr(self.result, "_value", None)
        if value is None or isinstance(value, Tracer) or np.ndim(value) == 0:
            return eqx.tree_pformat(self)
        return eqx.tree_pformat(eqx.tree_at(lambda sol: sol.result, self, _Words(_result(self.result))))

    def _repr_html_(self) -> str:
        """A table for a notebook; nothing is computed."""
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(self)):
            return table("DAESolution", {"traced": "inside jit, vmap or grad"})
        return table("DAESolution", _found(self))


class _Words:
    """What is printed as it is."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return f"<{self.text}>"


def _found(sol: DAESolution) -> dict[str, str]:
    """What a solution holds, in words."""
    # A batch has those of each.
    stats = {name: x for name, x in sol.stats.items() if x is not None and np.ndim(x) == 0}
    counted = {"num_accepted_steps": "accepted", "num_rejected_steps": "rejected"}
    steps = [f"{int(stats[name])} {word}" for name, word in counted.items() if name in stats]
    rows = {
        "result": _result(sol.result),
        "interval": " to ".join(f"{float(t):g}" if np.ndim(t) == 0 else eqx.tree_pformat(t) for t in (sol.t0, sol.t1)),
        "saved times": "none" if sol.ts is None else eqx.tree_pformat(sol.ts),
        "saved states": "none" if sol.ys is None else eqx.tree_pformat(sol.ys),
        "steps": ", ".join(steps),
        "compile time": f"{float(stats['compile_seconds']):.3g} s" if "compile_seconds" in stats else "",
        "dense output": "" if sol.interpolation is None else "sol.evaluate(t)",
        "independent constraints": "" if sol.rank is None else str(sol.rank),
        "precision": sol.precision,
    }
    return {name: text for name, text in rows.items() if text}


def _result(result: Any) -> str:
    """The message of one code; of a batch, how many solves were successful."""
    codes = np.asarray(result._value)
    if codes.ndim == 0:
        return RESULTS[result]
    good = int(np.sum(codes == np.asarray(RESULTS.successful._value)))
    return f"{good} of {codes.size} successful"


def precision_of(dtype: DType, controller: diffrax.AbstractStepSizeController) -> str:
    """With how many digits a solve computes and what it allows for an error, in words."""
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return f"{np.dtype(dtype)}, fixed steps"
    given = {name: getattr(controller, name, None) for name in ("rtol", "atol")}
    numbers = [f"{name} {value:g}" for name, value in given.items() if isinstance(value, float | int)]
    each = [f"{name} for each unknown" for name, value in given.items() if _is_one_each(value)]
    return ", ".join([str(np.dtype(dtype)), *numbers, *each])


def _is_one_each(tolerance: PyTree) -> bool:
    return not jax.tree_util.all_leaves([tolerance]) or jnp.ndim(tolerance) > 0


@jax.jit
def _last(ts: Float[Array, "*batch times"], ys: State) -> Any:
    if ts.ndim > 1:
        return jax.vmap(_last)(ts, ys)
    last = last_saved(ts)
    return jax.tree.map(lambda y: y[last], ys)


def went_well(result: Any) -> BoolScalar:
    """Whether a solve came to its end, or an event ended it."""
    return (result == RESULTS.successful) | (result == RESULTS.event_occurred)


def last_saved(ts: Float[Array, " times"]) -> Any:
    """The number of the last row that was saved; 0 where none was."""
    return jnp.maximum(jnp.sum(jnp.isfinite(ts)) - 1, 0)


def without_padding(ts: Float[Array, "*batch times"], ys: State) -> tuple[Any, Any]:
    """Saved times and states with padding, times that are infinite, overwritten by the last ones that were saved: every
    function of them then has its value there, and its largest and smallest are those over the saved times.
    """
    at = jnp.minimum(jnp.arange(ts.shape[0]), last_saved(ts))
    return ts[at], jax.tree.map(lambda y: y[at], ys)


def saved_arrays(sol: DAESolution) -> tuple[Any, State, Args, Args]:
    """`ts`, `ys`, `args` and `changed` as arrays of JAX. Those of a solution that `sweep` returns are numpy's, which `filter_vmap`
    takes for the same in all lanes.
    """
    parts = sol.ts, sol.ys, sol.args, sol.changed
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, parts)


@quickly_compiled
def at_saved_times(
    of: Callable[..., Any],
    what: PyTree,
    ts: Float[Array, "*batch times"],
    ys: State,
    args: Args,
    changed: Args,
    *more: Array,
) -> Any:
    """of(what, t, y, *more, args) at each saved time of a solution; `more` has these along its first axis."""
    ts, (ys, changed) = without_padding(ts, (ys, changed))
    return jax.vmap(lambda t, y, c, *more: of(what, t, y, *more, eqx.combine(c, args)))(ts, ys, changed, *more)


def all_finite(ts: Float[Array, "*batch times"], ys: State) -> Any:
    """Whether every saved state is finite; times that are not finite are padding."""
    saved = jnp.isfinite(ts)
    finite = [
        jnp.all(jnp.isfinite(y).reshape(y.shape[0], -1), axis=1)
        for y in jax.tree.leaves(ys)
        if jnp.issubdtype(y.dtype, jnp.inexact)
    ]
    return jnp.all(jnp.stack([jnp.all(f | ~saved) for f in finite])) if finite else jnp.asarray(True)
