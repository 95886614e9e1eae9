"""QR by Householder reflections, of small matrices."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..scalar_interpreter import Unsupported
from .factorisations import of_batch, refuse_large


def qr(a: Array, *, pivoting: bool, full_matrices: bool, **_: object) -> tuple[Any, Any]:
    """Q and R."""
    if pivoting:
        raise Unsupported("qr with pivoting")
    m, n = a.shape[-2:]
    k = m if full_matrices else min(m, n)
    reflections, taus = geqrf(a)
    wide = jnp.zeros((*a.shape[:-2], m, k), a.dtype).at[..., :, : min(n, k)].set(reflections[..., :, : min(n, k)])
    return householder_product(wide, taus), jnp.triu(reflections[..., :k, :])


def geqrf(a: Array, **_: object) -> tuple[Any, Any]:
    """R, the reflections' vectors below it, and their factors τ, as LAPACK has them: H = 1 − τ v vᴴ with v₀ = 1."""
    refuse_large("geqrf", *a.shape[-2:])
    return of_batch(_reflected, a.ndim - 2)(a)


def _reflected(a: Array) -> tuple[Any, Any]:
    m, n = a.shape
    row = jnp.arange(m)

    def reflect(k: Array | int, carry: tuple[Array, ...]) -> Any:
        a, taus = carry
        alpha, below = a[k, k], jnp.where(row > k, a[:, k], 0)
        # Squares of the entries as they are may overflow, or be 0.
        largest = jnp.maximum(jnp.max(jnp.abs(below)), jnp.abs(alpha))
        unit = jnp.where(largest > 0, largest, 1)
        length = unit * jnp.sqrt(jnp.sum(_square(below / unit)) + _square(alpha / unit))
        beta = jnp.where(alpha.real >= 0, -length, length)
        # Nothing is reflected that points along the first axis already.
        still = jnp.all(below == 0) & (alpha.imag == 0 if jnp.iscomplexobj(a) else True)
        tau = jnp.where(still, 0, (beta - alpha) / jnp.where(still, 1, beta))
        v = jnp.where(row == k, 1, below / jnp.where(still, 1, alpha - beta))
        a_after = a - jnp.conj(tau) * v[:, None] * (v.conj() @ a)
        a_after = jnp.where(jnp.arange(n) > k, a_after, a)
        column = jnp.where(row > k, v, jnp.where(row == k, jnp.where(still, alpha, beta.astype(a.dtype)), a[:, k]))
        return a_after.at[:, k].set(column), taus.at[k].set(tau)

    taus = jnp.zeros(min(m, n), a.dtype)
    return jax.lax.fori_loop(0, min(m, n), reflect, (a, taus))


def _square(x: Array) -> Any:
    return x.real**2 + x.imag**2 if jnp.iscomplexobj(x) else x * x


def householder_product(a: Array, taus: Array, **_: object) -> Any:
    """The first columns of the product of the reflections."""
    refuse_large("householder_product", *a.shape[-2:])
    return of_batch(_product, a.ndim - 2)(a, taus)


def _product(a: Array, taus: Array) -> Any:
    m, n = a.shape
    row, count = jnp.arange(m), len(taus)

    def reflect(i: Array | int, q: Array) -> Any:
        k = count - 1 - i
        v = jnp.where(row == k, 1, jnp.where(row > k, a[:, k], 0))
        return q - taus[k] * v[:, None] * (v.conj() @ q)

    return jax.lax.fori_loop(0, count, reflect, jnp.eye(m, n, dtype=a.dtype))
