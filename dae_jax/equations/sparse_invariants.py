"""The invariants of a large system: a sparse ∂H/∂Y, and the nearest point on the linearisation of H = 0."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..linalg.pivoted_lu import PivotedLU
from ..structure import column_colouring
from ..types import Time


if TYPE_CHECKING:
    from .structural_ode import StructuralODE


@dataclasses.dataclass(frozen=True, eq=False)
class SparseInvariants:
    """∂H/∂Y has entries at (`rows`, `columns`), found as directional derivatives along `colours` of the entries of Y, −1 for
    those along none. Compared by identity.
    """

    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    colours: Int[np.ndarray, " N"]
    count: int

    @classmethod
    def of(cls, ode: "StructuralODE", pattern: Any) -> "SparseInvariants":
        """`pattern`: the variables of each equation F̄ᵢ, with any of their derivatives, as a sparse matrix.

        d^kF̄ᵢ/dt^k has, of each of them, derivatives of orders 0 to k + 1 at most.
        """
        orders, variable_colours = ode.orders, column_colouring(pattern)
        n_colours = int(variable_colours.max(initial=-1)) + 1
        inside = [place < orders.size for place in orders.places]
        colours = np.full(orders.size, -1)
        rows, columns, first = [], [], 0
        for k in range(max(orders.equations)):
            of_level = orders.rows(k)
            place, variable = pattern[of_level].nonzero()
            for m in range(min(k + 2, len(orders.places))):
                there = inside[m][variable] & (orders.places[m][variable] >= 0)
                rows.append(first + place[there])
                columns.append(orders.places[m][variable[there]])
            first += len(of_level)
        for m, place in enumerate(orders.places):
            there = inside[m] & (place >= 0)
            colours[place[there]] = m * n_colours + variable_colours[there]
        return cls(np.concatenate(rows), np.concatenate(columns), colours, int(colours.max()) + 1)

    def entries(self, ode: "StructuralODE", t: Time, y: Float[Array, " N"]) -> Float[Array, " entries"]:
        """The entries at (t, Y)."""
        along = lambda seed: jax.jvp(lambda y: ode.violations(t, y), (y,), (seed,))[1]
        seeds = (jnp.asarray(self.colours) == jnp.arange(self.count)[:, None]).astype(y.dtype)
        return jax.vmap(along)(seeds)[self.colours[self.columns], self.rows]

    def row_sums(self, entries: Float[Array, " entries"]) -> Float[Array, " m"]:
        """Their sums, row by row."""
        return jax.ops.segment_sum(entries, self.rows, int(self.rows.max(initial=-1)) + 1)

    def nearest(
        self,
        ode: "StructuralODE",
        t: Time,
        y: Float[Array, " N"],
        start: Float[Array, " N"],
        weights: Float[Array, " N"],
    ) -> Float[Array, " N"]:
        """The point next to `start` on the linearisation of H = 0 at Y, in the metric in which entries count as 1/`weights`.

        From u = Sᵀ p and S u + ε p = b for the equations S u = b of u = (start − Y)/weights, rows of length 1.
        """
        a, h = self.entries(ode, t, y), ode.violations(t, y)
        b = h + self.row_sums(a * (start - y)[self.columns])
        s = a * weights[self.columns]
        lengths = jnp.sqrt(self.row_sums(s * s))
        scale = 1 / jnp.where(lengths > 0, lengths, 1)
        s, b = s * scale[self.rows], b * scale
        # What the free entries cannot mend stays as it is, in place of growing without bound.
        cut = 100 * jnp.finfo(y.dtype).eps
        entries = jnp.concatenate([jnp.ones_like(y), -s, s, jnp.full_like(h, cut)])
        u = self._augmented.solve(entries, jnp.concatenate([jnp.zeros_like(y), b]))[: len(y)]
        return start - weights * u

    @functools.cached_property
    def _augmented(self) -> PivotedLU:
        n, m = len(self.colours), int(self.rows.max(initial=-1)) + 1
        first, second = np.arange(n), n + np.arange(m)
        rows = np.concatenate([first, self.columns, n + self.rows, second])
        columns = np.concatenate([first, n + self.rows, self.columns, second])
        return PivotedLU(rows, columns, n + m)
