"""Linear equations x − K x = b by successive substitution, where K is known by its products and shortens all vectors in the end."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..types import Flat
from .newton import fixed_point


# Of a K with the spectral radius 0.95 as many reach round-off.
MOST = 700


def solve_contraction(k: Callable[[Flat], Flat], b: Float[Array, " n"]) -> Any:
    """x with x − K x = b, by x ← b + K x; NaN where that does not converge. `k` is linear, and is transposed for the reverse mode: of
    the derivative of a fixed point y = f(y) with K = ∂f/∂y it converges as fast as the iteration for y.
    """

    def iterated(k: Callable[[Flat], Flat]) -> Callable[[Any, Flat], Flat]:
        def solve(_: Any, b: Flat) -> Flat:
            def correct(x: Flat) -> tuple[Flat, Float[Array, ""]]:
                new = b + k(x)
                size = jnp.max(jnp.abs(new), initial=jnp.finfo(b.dtype).tiny)
                return new, jnp.max(jnp.abs(new - x), initial=0.0) / size

            x, found = fixed_point(correct, b, max_steps=MOST)
            return x * jnp.where(found, 1.0, jnp.nan).astype(b.dtype)

        return solve

    transposed = jax.linear_transpose(k, b)
    return lax.custom_linear_solve(
        lambda x: x - k(x), b, solve=iterated(k), transpose_solve=iterated(lambda x: transposed(x)[0])
    )
