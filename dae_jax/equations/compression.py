"""Sparse Jacobians as few directional derivatives."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..types import Flat


@dataclasses.dataclass(frozen=True, eq=False)
class Compression:
    """A Jacobian as directional derivatives, one for each colour of its columns (−1: in none), and where its stored entries are
    among them (−1: 0).
    """

    colours: Int[np.ndarray, " n"]
    places: Int[np.ndarray, "*stored"]

    @property
    def count(self) -> int:
        """How many colours there are."""
        return int(self.colours.max(initial=-1)) + 1

    def jacobian(self, fn: Callable[[Flat], Flat], x: Float[Array, " n"]) -> Float[Array, "*stored"]:
        """The stored entries of ∂fn/∂x."""
        seeds = (jnp.asarray(self.colours) == jnp.arange(self.count)[:, None]).astype(x.dtype)
        compressed = jax.vmap(lambda seed: jax.jvp(fn, (x,), (seed,))[1])(seeds)
        return jnp.where(self.places >= 0, compressed.reshape(-1)[self.places], 0)
