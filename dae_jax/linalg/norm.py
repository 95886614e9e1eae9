"""The norm that step-size control measures errors in."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


def rms_norm(x: PyTree) -> Float[Array, ""]:
    """The root mean square of all numbers of a pytree; its derivative at 0 is 0.

    `optimistix.rms_norm` as a sum: a dot product is a library call, which keeps a loop from becoming one kernel.
    """
    leaves = [leaf for leaf in map(jnp.asarray, jax.tree.leaves(x)) if leaf.size]
    if not leaves:
        return jnp.zeros(())
    total = sum(jnp.sum(jnp.real(leaf * jnp.conj(leaf))) for leaf in leaves) / sum(leaf.size for leaf in leaves)
    return jnp.sqrt(jnp.where(total == 0, 1, total)) * (total != 0)


def error_norm(x: PyTree) -> Float[Array, ""]:
    """`rms_norm`, infinite where it is not a number: an infinite error as a part of an infinite state, after which the step of
    `diffrax.PIDController` would not be a number either, and all later ones.
    """
    size = rms_norm(x)
    return jnp.where(jnp.isnan(size), jnp.inf, size)
