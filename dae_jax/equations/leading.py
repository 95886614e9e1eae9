"""The matrix by which equations that are solved as they are written determine the highest derivatives."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linalg import signed_log_determinant
from ..structure import Block, block_triangular, interpreted
from ..types import DType, Flat, Time
from .derivative_orders import Form, find_offsets
from .manifold_ode import at_one_instant
from .structural_ode import ORIENTED


class _LeadingBlock(NamedTuple):
    """A diagonal block, and of each entry how often its variable is differentiated: −1 where it is 0."""

    block: Block
    orders: tuple[tuple[int, ...], ...]


@dataclasses.dataclass(frozen=True)
class LeadingMatrix:
    """∂Fᵢ/∂yⱼ^(dⱼ − cᵢ), the system Jacobian of the Σ-method, by its diagonal blocks that depend on anything.

    Source: J. D. Pryce, BIT 41 (2001), 364–394.
    """

    blocks: tuple[_LeadingBlock, ...]

    @classmethod
    def of(cls, form: Form, dtype: DType) -> "LeadingMatrix":
        """Finds the blocks while tracing; none where highest derivatives cancel between equations, of a large system, and where
        structural analysis does not know an operation.
        """
        try:
            found = find_offsets(form, dtype)
        except NotImplementedError:
            return cls(())
        if found.combination.rows or form.size > ORIENTED:
            return cls(())
        c, d = (np.array(x) for x in (found.sigma.equation_offsets, found.sigma.variable_offsets))
        present = np.zeros((form.size, form.size), bool)
        for i, variables in enumerate(found.pattern):
            present[i, variables] = True
        orders = np.where(present, d - c[:, None], -1)
        whole = lambda block: _LeadingBlock(block, tuple(map(tuple, orders[np.ix_(*block)].tolist())))
        blocks = [whole(block) for block in block_triangular(found.pattern, found.sigma.transversal)]
        time, y = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((form.size,), dtype)
        varies = lambda block: np.isnan(interpreted(functools.partial(_entries, form, block), time, y, y).numbers).any()
        return cls(tuple(filter(varies, blocks)))

    @at_one_instant
    def determinants(self, form: Form, t: Time, y: Flat, yd: Flat) -> Float[Array, "2 blocks"]:
        """Of each block the sign of the determinant and log |det|."""
        t, y, yd = lax.stop_gradient((jnp.asarray(t, y.dtype), y, yd))
        return jnp.stack([jnp.stack(signed_log_determinant(_entries(form, x, t, y, yd))) for x in self.blocks], 1)


def _entries(form: Form, leading: _LeadingBlock, t: Time, y: Flat, yd: Flat) -> Float[Array, "block block"]:
    (rows, columns), orders = leading.block, np.array(leading.orders)
    columns = np.array(columns)

    def by(order: int) -> Float[Array, "block block"]:
        point = [y, yd]

        def moved(x: Flat) -> Flat:
            point[order] = (y, yd)[order].at[columns].set(x)
            return form.residual(t, *point)[np.array(rows)]

        return jax.jacfwd(moved)((y, yd)[order][columns])

    zero = jnp.zeros(orders.shape, y.dtype)
    found = [jnp.where(jnp.asarray(orders == k), by(k), 0) if (orders == k).any() else zero for k in (0, 1)]
    return found[0] + found[1]
