"""The reverse derivative of a solve from a tape of its accepted steps.

The derivative is that of the discrete solution (discretise-then-optimise), as with `diffrax.RecursiveCheckpointAdjoint`;
the sizes of the steps are constants, but for the last, which ends at t1. Forwards, the point of every accepted step is
written down; backwards, each step is done once more together with its derivative. Both are loops of plain arithmetic,
which compile to a kernel each; diffrax's checkpoints need library calls. It is used where the tape is small, and for
solvers whose state is a function of the step's start.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from ..solvers import is_recomputable
from ..types import IntScalar, Scalar, Time, Y
from .start import is_saved_part


if TYPE_CHECKING:
    from .program import Solve


# Numbers on the tape, at most; beyond that diffrax's checkpoints.
LARGEST_TAPE = 2**20


def can_be_taped(solve: "Solve", size: int) -> bool:
    """Whether the tape serves a solve with `size` unknowns."""
    saveat, part = solve.saveat, solve.saveat.subs
    return (
        is_saved_part(part)
        and not (part.steps or saveat.dense or saveat.solver_state or saveat.controller_state or saveat.made_jump)
        and solve.event is None
        and type(solve.controller) in (diffrax.PIDController, diffrax.ConstantStepSize)
        and solve.max_steps is not None
        and (solve.max_steps + 1) * size <= LARGEST_TAPE
        and is_recomputable(solve.solver)
    )


def recorded(saveat: diffrax.SaveAt) -> Any:
    """`saveat`, with every accepted step saved beside."""
    tape = diffrax.SubSaveAt(t0=True, steps=True, fn=as_it_is)
    return eqx.tree_at(lambda s: s.subs, saveat, {"user": saveat.subs, "tape": tape}, is_leaf=is_saved_part)


# What the tape holds: the point in the integration's variables.
as_it_is = lambda t, y, ode: y


class Taped(NamedTuple):
    """What a solve depends on, once the state is encoded; the leaves that are inexact arrays have cotangents."""

    formulation: Any
    solver: Any
    part: Any
    t0: Any
    t1: Any
    y: Any
    ode: Any
    view: Any


def cotangents(taped: Taped, fixed_steps: bool, tape: tuple[Float[Array, " steps"], Y], wanted: PyTree[Array]) -> Taped:
    """The cotangents of the inexact arrays in `taped`.

    **Arguments**

    - `fixed_steps`: whether the steps divide the interval evenly; otherwise all have sizes of their own but the last.
    - `tape`: times and points of the accepted steps, the start first; times that are not finite are padding.
    - `wanted`: the cotangents of the saved values, a leading axis of times.
    """
    times, points = tape
    numbers, rest = eqx.partition(taped, eqx.is_inexact_array)
    part = taped.part
    save_times = jnp.zeros(0, times.dtype) if part.ts is None else part.ts
    first = int(part.t0)
    direction = jnp.sign(taped.t1 - taped.t0)
    last = jnp.sum(jnp.isfinite(times)) - 1

    def saved(numbers: PyTree, t: Time, y: Y) -> Any:
        all_of = eqx.combine(numbers, rest)
        return all_of.view(t, y, all_of.ode)

    def step(numbers: PyTree, y: Y, a: Scalar, b: Scalar) -> Any:
        all_of = eqx.combine(numbers, rest)
        term, solver, ode = all_of.formulation.term(), all_of.solver, all_of.ode
        y1, _, dense, *_ = solver.step(term, a, b, y, ode, solver.init(term, a, b, y, ode), False)
        return y1, dense if save_times.size else None

    def within(numbers: PyTree, dense: PyTree, a: Scalar, b: Scalar, t: Time) -> Any:
        solver = eqx.combine(numbers, rest).solver
        return saved(numbers, t, solver.interpolation_cls(t0=a, t1=b, **dense).evaluate(t))

    def shared(k: IntScalar, cotangent: Scalar) -> tuple[Any, Any]:
        """The cotangent of the k-th time as those of t0 and t1: how diffrax's controllers make it from them."""
        evenly = jnp.where(k == 1, 0.0, (times[k] - taped.t0) / (taped.t1 - taped.t0)) if fixed_steps else 0.0
        fraction = jnp.where(times[k] == taped.t1, 1.0, evenly)
        return (1 - fraction) * cotangent, fraction * cotangent

    def saves_in_step(k: IntScalar, dense: PyTree, carry: tuple[PyTree, ...]) -> Any:
        a, b = times[k], times[k + 1]

        def more(carry: tuple[PyTree, ...]) -> Any:
            j = carry[0]
            return (j >= 0) & ((direction * (save_times[j] - a) > 0) | (k == 0))

        def pull(carry: tuple[PyTree, ...]) -> Any:
            j, of_numbers, of_dense, of_a, of_b, of_times = carry
            _, pull_back = jax.vjp(within, numbers, dense, a, b, save_times[j])
            more_numbers, more_dense, more_a, more_b, of_t = pull_back(_entry(wanted, first + j))
            of_times = lax.dynamic_update_index_in_dim(of_times, of_times[j] + of_t, j, 0)
            return (
                j - 1,
                _sum(of_numbers, more_numbers),
                _sum(of_dense, more_dense),
                of_a + more_a,
                of_b + more_b,
                of_times,
            )

        return lax.while_loop(more, pull, carry)

    def one_step(carry: tuple[PyTree, ...]) -> Any:
        k, j, of_y, of_numbers, of_t0, of_t1, of_times = carry
        (_, dense), pull_back = jax.vjp(step, numbers, _entry(points, k), times[k], times[k + 1])
        of_dense, of_a, of_b = _zeros(dense), jnp.zeros_like(of_t0), jnp.zeros_like(of_t0)
        if save_times.size:
            j, of_numbers, of_dense, of_a, of_b, of_times = saves_in_step(
                k, dense, (j, of_numbers, of_dense, of_a, of_b, of_times)
            )
        more_numbers, of_y, more_a, more_b = pull_back((of_y, of_dense))
        (a0, a1), (b0, b1) = shared(k, of_a + more_a), shared(k + 1, of_b + more_b)
        return k - 1, j, of_y, _sum(of_numbers, more_numbers), of_t0 + a0 + b0, of_t1 + a1 + b1, of_times

    of_y, of_numbers, zero = _zeros(_entry(points, 0)), _zeros(numbers), jnp.zeros_like(taped.t0)
    of_t1 = zero
    if part.t1:
        _, pull_back = jax.vjp(saved, numbers, taped.t1, _entry(points, last))
        of_numbers, of_t1, of_y = pull_back(_entry(wanted, -1))
    carry = (last - 1, save_times.size - 1, of_y, of_numbers, zero, of_t1, jnp.zeros_like(save_times))
    *_, of_y, of_numbers, of_t0, of_t1, of_times = lax.while_loop(lambda carry: carry[0] >= 0, one_step, carry)
    if part.t0:
        _, pull_back = jax.vjp(saved, numbers, taped.t0, taped.y)
        more_numbers, more_t0, more_y = pull_back(_entry(wanted, 0))
        of_numbers, of_t0, of_y = _sum(of_numbers, more_numbers), of_t0 + more_t0, _sum(of_y, more_y)
    of_numbers = of_numbers._replace(t0=of_numbers.t0 + of_t0, t1=of_numbers.t1 + of_t1, y=_sum(of_numbers.y, of_y))
    if part.ts is None:
        return of_numbers
    return eqx.tree_at(lambda n: n.part.ts, of_numbers, of_numbers.part.ts + of_times)


def saved_times(
    of_taped: Taped, part: diffrax.SubSaveAt, of_t0: Scalar, of_t1: Scalar, of_ts: Float[Array, " times"]
) -> Taped:
    """`cotangents` with those of the times that a solution holds: its t0, t1, and the ts that `part` asks for."""
    of_part = of_taped.part
    if part.ts is not None:
        first = int(part.t0)
        of_part = eqx.tree_at(lambda p: p.ts, of_part, of_part.ts + of_ts[first : first + part.ts.size])
    of_t0 = of_taped.t0 + of_t0 + (of_ts[0] if part.t0 else 0)
    of_t1 = of_taped.t1 + of_t1 + (of_ts[-1] if part.t1 else 0)
    return of_taped._replace(t0=of_t0, t1=of_t1, part=of_part)


def _entry(tree: PyTree[Array], i: IntScalar | int) -> Any:
    return jax.tree.map(lambda x: x[i], tree)


def _zeros(tree: PyTree[Array]) -> Any:
    return jax.tree.map(jnp.zeros_like, tree)


def _sum(a: PyTree[Array], b: PyTree[Array]) -> Any:
    return jax.tree.map(jnp.add, a, b)
