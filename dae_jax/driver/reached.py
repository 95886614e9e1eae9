"""Which of the saved values are answers: those of times that the solve has reached, and only these have derivatives."""

import dataclasses
import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree

from ..solution import DAESolution, last_saved, went_well
from ..types import BoolScalar
from .known_derivatives import with_transpose
from .start import is_saved_part


def without_stop(sol: DAESolution, saveat: diffrax.SaveAt) -> DAESolution:
    """The solution without what `SaveAt(t1=True)` has of a solve that failed: the state at which it stopped, which is `sol.end`, would
    pass for that at t1.
    """
    if sol.ts is None:  # of `SaveAt(dense=True)`
        return sol
    okay = went_well(sol.result)
    structure = jax.tree.structure(saveat.subs, is_leaf=is_saved_part)
    parts = zip(*map(structure.flatten_up_to, (saveat.subs, sol.ts, sol.ys)), strict=True)
    ts, ys = zip(*[_without_stop(part, okay, t, y) for part, t, y in parts], strict=True)
    return dataclasses.replace(sol, ts=structure.unflatten(ts), ys=structure.unflatten(ys), given=sol.given)


def with_derivatives(sol: DAESolution, given: list[Array]) -> DAESolution:
    """The solution, of which what is no number has no derivative by what is `given` to the solve."""
    numbers, others = eqx.partition(sol.ys, eqx.is_inexact_array)
    if not jax.tree.leaves(numbers):
        return sol
    return dataclasses.replace(sol, ys=eqx.combine(_with_derivatives(numbers, given), others), given=sol.given)


def _without_stop(part: diffrax.SubSaveAt, okay: BoolScalar, ts: Any, ys: Any) -> tuple[Any, Any]:
    """Of a solve that is not `okay`, without the row of t1, which is that of where it has stopped."""
    if not part.t1 or part.steps:
        return ts, ys
    gone = ~okay & (jnp.arange(ts.size) == last_saved(ts))
    return jax.tree.map(functools.partial(without_rows, gone, jnp.inf), (ts, ys))


def without_rows(rows: Bool[Array, " times"], instead: float, x: Array) -> Array:
    """`instead` in these rows of saved numbers; integers have none."""
    if not jnp.issubdtype(x.dtype, jnp.inexact):
        return x
    return jnp.where(rows.reshape(-1, *[1] * (x.ndim - 1)), instead, x)


@jax.custom_jvp
def _with_derivatives(saved: PyTree[Array], given: list[Array]) -> PyTree[Array]:  # noqa: ARG001
    """What is `saved`, with a derivative of NaN where it is no number, as after the time at which a solve has failed or an event has
    ended it: the zero there would pass for an answer. Likewise in reverse mode, of all that is `given`, where a cotangent is not 0, as
    that of what a loss leaves out is.
    """
    return saved


@_with_derivatives.defjvp
def _(primals: tuple[PyTree, list[Array]], tangents: tuple[PyTree, list[Array]]) -> tuple[PyTree, PyTree]:
    saved, _ = primals
    change, of_given = tangents
    known, _ = ravel_pytree((jax.tree.map(jnp.isfinite, saved), True))

    def forward(changes: Array) -> Array:
        return jnp.where(known, changes, jnp.nan)

    def backward(wanted: Array) -> Array:
        lost = jnp.any(~known & (wanted != 0))
        return jnp.where(known, wanted, 0).at[-1].set(jnp.where(lost, jnp.nan, 0))

    return saved, with_transpose((change, sum(map(jnp.sum, of_given))), forward, backward)[0]
