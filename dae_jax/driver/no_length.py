"""An interval without length: no step is taken and all that is saved is the start, but it moves with its times as that of any other."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from ..equations.manifold_ode import Equations
from ..types import BoolScalar, Scalar, Y
from .between_steps import Flow, held
from .start import is_saved_part


class Begin(eqx.Module):
    """A start (t, y), in the solver's variables, and what is saved of a point that the `flow` moves, `view(t, y, ode)`."""

    t: Scalar
    y: Y
    flow: Flow
    view: Any
    ode: Equations

    def at(self, times: Float[Array, " rows"]) -> Any:
        """What is saved at `times` that are t, with derivatives by all of them."""
        y = held(self.y, self.t, self.flow, self.ode)
        return lax.map(lambda t: self.view(t, y, self.ode), times)


def moving_with_times(
    parts: PyTree, ts: Any, ys: Any, begin: Callable[[Any], Begin], t1: Scalar, is_all: BoolScalar
) -> tuple[Any, Any]:
    """The times `ts` and values `ys` of the `parts` that are saved, which move with their times where the start, `begin(fn)`, `is_all`
    that was saved of an interval to t1.
    """

    def moving(part: diffrax.SubSaveAt, *saved: Any) -> Any:
        if part.steps:
            return saved
        start = begin(part.fn)
        return _moving(row_times(part, start.t, t1), start, is_all, saved)

    both = jax.tree.map(moving, parts, ts, ys, is_leaf=is_saved_part)
    of_both = lambda k: jax.tree.map(lambda _, saved: saved[k], parts, both, is_leaf=is_saved_part)
    return of_both(0), of_both(1)


def row_times(part: diffrax.SubSaveAt, t0: Scalar, t1: Scalar) -> Float[Array, " rows"]:
    """The times of what is saved, but at steps."""
    ends = lambda is_saved, t: jnp.broadcast_to(t, (int(is_saved),))
    between = jnp.zeros(0, jnp.result_type(t0)) if part.ts is None else part.ts
    return jnp.concatenate([ends(part.t0, t0), between, ends(part.t1, t1)])


@eqx.filter_custom_jvp
def _moving(times: Float[Array, " rows"], begin: Begin, is_all: BoolScalar, saved: tuple[Array, Any]) -> Any:  # noqa: ARG001
    """What was `saved`, times and values, which move with these `times` where the start `is_all` of it."""
    return saved


@_moving.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    (times, begin, is_all, saved), (of_times, of_begin, _, change) = primals, tangents
    or_zero = lambda x, dx: jnp.zeros_like(x) if dx is None and eqx.is_inexact_array(x) else dx
    change = jax.tree.map(or_zero, saved, change)
    if of_times is None and of_begin.t is None and not begin.flow.later:
        return saved, change

    def moved() -> Any:
        show = lambda times, begin: (times, begin.at(times))
        _, found = eqx.filter_jvp(show, (times, begin), (of_times, of_begin))
        return jax.tree.map(lambda x, dx: x if dx is None else dx.astype(x.dtype), change, found)

    return saved, lax.cond(is_all, moved, lambda: change)
