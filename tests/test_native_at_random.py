"""Programs put together at random: what our compiler makes of them gives what XLA makes of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.kernels.native import compiled


def pairs(a, b):
    """Rows of two numbers, and as many of `a` as there are rows."""
    rows = b[: b.size // 2 * 2].reshape(-1, 2) if b.size > 1 else jnp.stack([b, b], 1)
    return a[:9], rows


def scanned(a, b):
    first, rows = pairs(a, b)
    last, (sums, ends) = jax.lax.scan(lambda c, u: (c * 0.5 + u[0], (c[0] + u, c[-1:])), first, rows)
    return jnp.concatenate([last, sums.reshape(-1), ends.reshape(-1)])


def looped(a, k, which):
    body = lambda c: (c[0] + 1, c[1].at[c[0] % a.size].add(0.1)[::-1], c[1])
    return jax.lax.while_loop(lambda c: c[0] < 4 + k, body, (0, a, a))[1 + which]


# Of two vectors, a place k that is found at run time, and a known number s.
OPERATIONS = (
    lambda a, b, k, s: jnp.sin(a) + 0.3,
    lambda a, b, k, s: a[: b.size] * b[: a.size],
    lambda a, b, k, s: a[: b.size] - b[::-1][: a.size],
    lambda a, b, k, s: a[::-1],
    lambda a, b, k, s: jnp.concatenate([a[: a.size // 2], b[: b.size // 3] * 0.5, a[:1]]),
    lambda a, b, k, s: a.at[1:].set(a[:-1]),
    lambda a, b, k, s: a.at[s % a.size].set(b[0]),
    lambda a, b, k, s: jax.lax.dynamic_update_slice(a, b[: max(1, a.size // 2)][: a.size], (k,)),
    lambda a, b, k, s: jax.lax.dynamic_slice(a, (k,), (max(1, a.size // 2),)),
    lambda a, b, k, s: jnp.where(a[: b.size] > b[: a.size], a[: b.size], jnp.tanh(b[: a.size])),
    lambda a, b, k, s: jnp.cumsum(a[:8]),
    lambda a, b, k, s: jnp.take(a, np.arange(1 + s % 40) * s % a.size),
    lambda a, b, k, s: jnp.pad(a[::2], (s % 3, s % 4), constant_values=0.25),
    lambda a, b, k, s: a * jnp.sum(b) / (1 + jnp.max(jnp.abs(b))),
    lambda a, b, k, s: (pairs(b, a)[1].T * 0.5 + 1).reshape(-1),
    lambda a, b, k, s: jax.lax.fori_loop(0, 3 + s % 4, lambda i, c: jnp.roll(c, 1) * 0.9 + i, a),
    lambda a, b, k, s: jax.lax.cond(k > 1, lambda u, v: u.at[0].set(v[0]), lambda u, v: jnp.cos(u), a, b),
    lambda a, b, k, s: looped(a, k, s % 2),
    lambda a, b, k, s: jnp.sum(jnp.outer(a[:20], b[:30]), s % 2),
    lambda a, b, k, s: jnp.stack([a[: b.size], b[: a.size]], s % 2).reshape(-1),
    lambda a, b, k, s: a.at[np.array([0, a.size - 1])].set(jnp.stack([b[-1], a[0]])),
    lambda a, b, k, s: scanned(a, b),
)


def program(seed):
    """A function of three numbers, of 4 to 13 operations on vectors of 1 to 600."""
    rng = np.random.default_rng(seed)
    size = int(rng.choice([6, 20, 30, 64, 100, 600]))
    steps = [(OPERATIONS[rng.integers(len(OPERATIONS))], *rng.integers(0, 1000, 3)) for _ in range(rng.integers(4, 14))]

    def fn(x):
        found = [jnp.linspace(0.1, 1, size) * x[0], jnp.cos(jnp.arange(max(3, size // 2)) * x[1]), x * 1.0]
        for operation, i, j, s in steps:
            a, b = found[i % len(found)], found[j % len(found)]
            found.append(jnp.clip(operation(a, b, jnp.int32(jnp.abs(x[0]) * 3), int(s)), -50, 50)[:600])
        return found[-4:]

    return fn


@pytest.mark.parametrize("seed", range(12))
def test_random_programs(seed):
    fn = program(seed)
    rng = np.random.default_rng(seed)
    one, many = rng.uniform(-1.5, 1.5, 3), rng.uniform(-1.5, 1.5, (11, 3))
    jaxpr = jax.make_jaxpr(fn)(one)
    for found, wanted in (
        (jax.jit(compiled(jaxpr))(one), jax.jit(fn)(one)),
        (jax.jit(compiled(jaxpr, (True,)))(many), jax.jit(jax.vmap(fn))(many)),
    ):
        for a, b in zip(found, wanted, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8)
