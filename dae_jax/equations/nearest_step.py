"""The shortest way to the solutions of linear equations for values and derivatives, of which the derivatives cost nothing."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg import row_products, solve
from ..types import IntScalar


def step_to(
    a: Float[Array, "m n"], off: Float[Array, " m"], weights: Float[Array, " n"], derivatives: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """x with A x = −`off`, in which the values, counted as 1/`weights`, are as short as can be; an entry of weight 0 stays.

    The derivatives are eliminated first, with complete pivoting: what is left are the equations for values alone, however fast the
    dynamics are. What no entry can mend is left as it is, in place of growing without bound.
    """
    eps, m = jnp.finfo(off.dtype).eps, len(off)
    free = derivatives & (weights > 0)
    largest = lambda x: jnp.max(jnp.abs(x), 1, initial=0)
    by_derivatives = largest(jnp.where(free, a, 0))
    size = jnp.where(by_derivatives > 0, by_derivatives, largest(a * weights))
    scale = 1 / jnp.where(size > 0, size, 1)
    columns = jnp.arange(a.shape[1])

    def eliminate(_: IntScalar, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        a, off, pivots = carry
        open_rows = jnp.sum(pivots, 1) == 0
        sizes = jnp.where(open_rows[:, None] & free, jnp.abs(a), -1)
        row = jnp.argmax(jnp.max(sizes, 1))
        column = jnp.argmax(sizes[row])
        at_row, at_column = jnp.arange(m) == row, columns == column
        counts = sizes[row, column] > eps**0.6
        pivot = jnp.where(counts, a[row, column], 1)
        others = jnp.where(counts & ~at_row, a[:, column], 0)
        line, value = a[row] / pivot, off[row] / pivot
        changed = (counts & at_row)[:, None]
        a = jnp.where(changed, line, a - others[:, None] * line)
        off = jnp.where(changed[:, 0], value, off - others * value)
        return a, off, jnp.where(changed & at_column, 1.0, pivots)

    none = jnp.zeros_like(a)
    a, off, pivots = lax.fori_loop(0, min(a.shape), eliminate, (a * scale[:, None], off * scale, none))
    solved = jnp.sum(pivots, 1)
    rest = jnp.where(free, 0, a * weights) * (1 - solved)[:, None]
    size = largest(rest)
    scale = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0)
    rest = rest * scale[:, None]
    gram = row_products(rest, rest)
    cut = 100 * eps * jnp.maximum(jnp.trace(gram), 1)
    values = -weights * jnp.sum(rest * solve(gram + cut * jnp.eye(m, dtype=a.dtype), scale * off)[:, None], 0)
    return values - jnp.sum(pivots * (off + jnp.sum(a * values, 1))[:, None], 0)
