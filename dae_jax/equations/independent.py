"""As many of a mechanism's constraints as are independent, for methods that cannot do with more."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compiler import quickly_compiled
from ..linalg import factorised, row_products
from ..systems import ConstrainedSystem, System, is_mechanism
from ..types import Args, Phase, State, Time
from .constraint_jacobian import Rank
from .mechanical import MechanicalODE
from .regularity import unit_rows


Rows = tuple[int, ...]


def independent(
    system: System, t: Time, state: State, args: Args, rank: int | Rank | None, rows: Rows | None = None
) -> ConstrainedSystem:
    """The system with the constraints `rows`, or where they are not known with as many as are independent at the
    state. The others follow from these, as long as these stay independent.
    """
    assert is_mechanism(system)
    ode = MechanicalODE.of(system, t, state, args, rank)
    m = ode.holonomic
    if ode.rank is None:
        return dataclasses.replace(system, rank=None)
    if rows is None:
        y, of_g = ode.encode(state), ode.rank[0]
        chosen = (_chosen(ode, t, y)[:, None] == jnp.arange(m + ode.nonholonomic)).astype(y[0].dtype)
        g, h = chosen[:of_g, :m], chosen[of_g:, m:]
        return _with(system, _Some.of(system.constraint, g), _Some.of(system.nonholonomic, h))
    of_g, of_h = tuple(i for i in rows if i < m), tuple(i - m for i in rows if i >= m)
    return _with(system, _Some.of(system.constraint, of_g), _Some.of(system.nonholonomic, of_h))


def _chosen(ode: MechanicalODE, t: Time, y: Phase) -> Int[Array, " rank"]:
    """As many constraints as are independent at a flat state, and of the holonomic ones as many as of these are."""
    a, _ = jax.lax.stop_gradient(unit_rows(ode, t, y))
    of_g, of_all = (ode.holonomic, len(a)) if ode.rank is None else ode.rank
    return jnp.sort(factorised(row_products(a, a), ((ode.holonomic, of_g), (len(a), of_all))).order)


def rows_of(system: System, t: Time, state: State, args: Args, rank: Rank) -> Rows:
    """Those of a start that is known."""
    assert is_mechanism(system)
    return tuple(map(int, _rows_of(system, t, state, args, rank)))


@quickly_compiled
def _rows_of(system: ConstrainedSystem, t: Time, state: State, args: Args, rank: Rank) -> Int[Array, " rank"]:
    ode = MechanicalODE.of(system, t, state, args, rank)
    return _chosen(ode, t, ode.encode(state))


def is_crowded(system: System, t: Time, state: State, args: Args) -> bool:
    """Whether a mechanism has at least as many constraints as coordinates."""
    assert is_mechanism(system)
    q, v = state
    g, h = system.constraint, system.nonholonomic
    # Of arguments: of numbers that are known it would be computed, operation by operation.
    found = eqx.filter_eval_shape(lambda t, q, v, args: (g and g(t, q, args), h and h(t, q, v, args)), t, q, v, args)
    return sum(x.size for x in jax.tree.leaves(found)) >= sum(jnp.size(x) for x in jax.tree.leaves(q))


def _with(system: ConstrainedSystem, g: "_Some | None", h: "_Some | None") -> ConstrainedSystem:
    return dataclasses.replace(system, constraint=g, nonholonomic=h, rank=None)


class _Some(eqx.Module):
    """Some of a function's values: `fixed` ones, whose pattern is known, or those of rows of the unit matrix."""

    function: Callable[..., Any]
    rows: Float[Array, "k m"] | None
    fixed: Rows | None = eqx.field(static=True)

    @classmethod
    def of(cls, function: Callable[..., Any] | None, rows: Rows | Float[Array, "k m"]) -> "_Some | None":
        if function is None or not len(rows):
            return None
        return cls(function, None, rows) if isinstance(rows, tuple) else cls(function, rows, None)

    def __call__(self, *at: Any) -> Float[Array, " k"]:
        values = jnp.ravel(self.function(*at))
        return values[np.array(self.fixed)] if self.rows is None else jnp.sum(self.rows * values, 1)
