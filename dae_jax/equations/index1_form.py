"""The index-1 equations that differentiation and a selection of states make of any system, for solvers of residuals."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg import take
from ..structure import dependence
from ..types import DType, State, Time
from .manifold_ode import at_one_instant
from .state_selection import selection
from .structural_ode import StructuralODE


class Index1Form(eqx.Module):
    """0 = F(t, z, ż) of index 1 for z = (Y, X), the state of a `StructuralODE` and the derivatives of order Dⱼ:

        0 = Fᵢ^(Cᵢ)(t, Y, X)                                for every equation,
        0 = Ẏₑ − (its derivative in (Y, X))                for the entries of Y that are integrated,
        0 = Hₖ(t, Y)                                        for the others, the dummy derivatives.

    `directions`: a unit row for each invariant, at the entry of Y that is its dummy derivative. It stands in for a
    `ResidualForm`.
    """

    ode: StructuralODE
    directions: Float[Array, "m N"]

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.ode.orders.size + self.ode.form.size

    @property
    def equations(self) -> tuple[str, ...]:
        """A name for each equation."""
        return (*(f"state[{i}]" for i in range(self.ode.orders.size)), *self.ode.equations)

    @property
    def variables(self) -> tuple[str, ...]:
        """A name for each unknown."""
        return (*(f"state[{i}]" for i in range(self.ode.orders.size)), *self.ode.form.variables)

    @property
    def shown(self) -> Bool[np.ndarray, " z"]:
        """Which unknowns are the user's."""
        return np.isin(np.arange(self.size), self.ode.orders.places[0][: self.ode.form.layout.size])

    @property
    def independent(self) -> Bool[np.ndarray, " z"]:
        """Which unknowns are the user's and do not follow from others of them: all of the user's."""
        return self.shown

    @property
    def may_cancel(self) -> bool:
        """Whether highest derivatives may cancel between equations."""
        return False

    def encode(self, t: Time, y: Float[Array, " N"]) -> Float[Array, " z"]:
        """(Y, X)."""
        return jnp.concatenate([y, self.ode.highest(t, y)])

    def decode(self, t: Time, z: Float[Array, " z"]) -> Any:
        """The state in the user's structure, with H(t, Y) = 0 to round-off: the steps, and more so the values between them, leave
        a part of the tolerance. Dummy derivatives move, as a nearest point depends on the unit of time.
        """
        form, y = self.ode.form, z[: self.ode.orders.size]
        on, found = self.ode.retract_along(t, y, selection(self.ode.orders, self.ode.leading(t, y))[0])
        settled = jnp.concatenate([jnp.where(found, on, y), z[y.size :]])
        return form.decode(t, take(settled, self.ode.orders.places[0][: form.layout.size]))

    def tolerances(self, t: Time, state: State, each: State, absolute: bool) -> Float[Array, " z"]:
        """A tolerance for each unknown, of one for `each` number of the state."""
        return jnp.concatenate(self.ode.derivatives_tolerances(t, state, each, absolute))

    def known_ydot(self, z: Float[Array, " z"]) -> Float[Array, " z"]:
        """What z itself says of ż: the rate of all of Y."""
        return jnp.concatenate([take(z, self.ode.orders.derivatives), jnp.zeros(self.ode.form.size, z.dtype)])

    def with_all_candidates(self, dtype: DType) -> "Index1Form":
        """With every entry that may become a dummy derivative marked by a half, for structural analysis: whatever is
        selected, its equations depend on no more.
        """
        orders = self.ode.orders
        t, y, x = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (orders.size,), (self.ode.form.size,)))
        pattern = dependence(self.ode.of_highest_order, t, y, x, derivative=True)[2]
        rows = []
        for k in range(1, max(orders.equations) + 1):
            place = orders.dummies(k)
            for i in orders.rows(k - 1):
                row = np.zeros(orders.size)
                row[place[pattern[i] & (place >= 0)]] = 0.5
                rows.append(row)
        return Index1Form(self.ode, jnp.asarray(np.reshape(rows, (len(rows), orders.size)), dtype))

    @at_one_instant
    def residual(self, t: Time, z: Float[Array, " z"], zd: Float[Array, " z"]) -> Float[Array, " z"]:
        """F(t, z, ż)."""
        orders = self.ode.orders
        y, x = z[: orders.size], z[orders.size :]
        highest = max(orders.equations)
        levels = self.ode.levels(t, y, x, highest + 1)
        last = self.ode.highest_of(levels)
        ydot = (zd - self.known_ydot(z))[: orders.size]
        if not highest:
            return jnp.concatenate([ydot, last])
        invariants = jnp.concatenate([take(levels[k], orders.rows(k)) for k in range(highest)])
        integrated = 1 - jnp.sum(self.directions, 0)
        return jnp.concatenate([integrated * ydot + jnp.sum(invariants[:, None] * self.directions, 0), last])
