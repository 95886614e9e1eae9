"""The invariants of a large system: a sparse ∂H/∂Y, and the nearest point on the linearisation of H = 0."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..linalg.pivoted_lu import Augmented
from ..linalg.storage import cutoff, scaling
from ..structure import column_colouring
from ..types import Time
from .compression import Compression


if TYPE_CHECKING:
    from .structural_ode import StructuralODE


# How much more derivatives may move than values, and the most.
FREE, FREEST = 1e3, 1e15
# An entry that is less than this part of others in its row is none, and over how many equations a weight is passed on.
SMALL, PASSED_ON = 1e-6, 3


@dataclasses.dataclass(frozen=True, eq=False)
class SparseInvariants:
    """∂H/∂Y, for m invariants, has entries at (`rows`, `columns`), found by their `compression`. Compared by identity."""

    m: int
    rows: Int[np.ndarray, " entries"]
    columns: Int[np.ndarray, " entries"]
    compression: Compression

    @classmethod
    def of(cls, ode: "StructuralODE", pattern: Any) -> "SparseInvariants":
        """`pattern`: the variables of each equation F̄ᵢ, with any of their derivatives, as a sparse matrix.

        d^kF̄ᵢ/dt^k has, of each of them, derivatives of orders 0 to k + 1 at most, and as many more as F̄ᵢ is made of derivatives.
        """
        orders, variable_colours = ode.orders, column_colouring(pattern)
        n_colours = int(variable_colours.max(initial=-1)) + 1
        inside = [place < orders.size for place in orders.places]
        colours = np.full(orders.size, -1)
        rows, columns, first = [], [], 0
        for k in range(max(orders.equations)):
            of_level = orders.rows(k)
            place, variable = pattern[of_level].nonzero()
            for m in range(min(k + 2 + ode.combination.degree, len(orders.places))):
                there = inside[m][variable] & (orders.places[m][variable] >= 0)
                rows.append(first + place[there])
                columns.append(orders.places[m][variable[there]])
            first += len(of_level)
        for m, place in enumerate(orders.places):
            there = inside[m] & (place >= 0)
            colours[place[there]] = m * n_colours + variable_colours[there]
        i, j = np.concatenate(rows), np.concatenate(columns)
        return cls(first, i, j, Compression(colours, colours[j] * first + i))

    def entries(self, ode: "StructuralODE", t: Time, y: Float[Array, " N"]) -> Float[Array, " entries"]:
        """The entries at (t, Y)."""
        return self.compression.jacobian(lambda y: ode.violations(t, y), y)

    def row_sums(self, entries: Float[Array, " entries"]) -> Float[Array, " m"]:
        """Their sums, row by row."""
        return jax.ops.segment_sum(entries, self.rows, self.m)

    def nearest(
        self,
        ode: "StructuralODE",
        t: Time,
        y: Float[Array, " N"],
        start: Float[Array, " N"],
        weights: Float[Array, " N"],
        derivatives: Bool[Array, " N"],
    ) -> Float[Array, " N"]:
        """The point next to `start` on the linearisation of H = 0 at Y, in the metric in which entries count as 1/`weights`,
        `derivatives` for little.

        By the shortest u = (start − Y)/weights with S u = b, rows of length 1.
        """
        a, h = self.entries(ode, t, y), ode.violations(t, y)
        b = h + self.row_sums(a * (start - y)[self.columns])
        # No part of the solution, which is differentiated.
        weights = jax.lax.stop_gradient(self._by_speed(a, weights, derivatives))
        s = a * weights[self.columns]
        # To length 1 by way of a largest entry of 1, as squares overflow before numbers do.
        largest = scaling(jax.lax.stop_gradient(jax.ops.segment_max(jnp.abs(s), self.rows, self.m)))
        s, b = s * largest[self.rows], b * largest
        scale = scaling(jnp.sqrt(self.row_sums(s * s)))
        s, b = s * scale[self.rows], b * scale
        # What the free entries cannot mend stays as it is, in place of growing without bound.
        u, _ = self._augmented.solve(s, cutoff(jnp.ones_like(h)), jnp.zeros_like(y), b)
        return start - weights * u

    def _by_speed(
        self, a: Float[Array, " entries"], weights: Float[Array, " N"], derivatives: Bool[Array, " N"]
    ) -> Float[Array, " N"]:
        """The weights, those of derivatives so large that in each equation a derivative moves before a value, however fast the dynamics
        are.
        """
        sizes, is_rate = jnp.abs(a), derivatives[self.columns]
        among = jax.ops.segment_max(jnp.where(is_rate, sizes, 0), self.rows, self.m)[self.rows]
        counts = is_rate & (sizes > SMALL * among)
        for part in (jnp.where(is_rate, 0, FREE), *[1.0] * PASSED_ON):
            most = jax.ops.segment_max(part * sizes * weights[self.columns], self.rows, self.m)
            needed = jnp.where(counts, most[self.rows] / jnp.where(counts, sizes, 1), 0)
            largest = jax.ops.segment_max(needed, self.columns, len(weights))
            raised = jnp.minimum(jnp.maximum(weights, largest), FREEST)
            weights = jnp.where(derivatives & (weights > 0), raised, weights)
        return weights

    @functools.cached_property
    def _augmented(self) -> Augmented:
        return Augmented(self.columns, self.rows, (len(self.compression.colours), self.m))
