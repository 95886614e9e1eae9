"""Derivatives along several directions at once, against those along one after another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from dae_jax import compiler
from dae_jax.equations.directions import along_each


N = 12


@jax.custom_jvp
def _twice(x):
    return 2 * x


_twice.defjvp(lambda x, dx: (_twice(*x), 2 * dx[0]))
ROWS = np.array([3, 0, 2, 2, 1])

FUNCTIONS = {
    "entrywise": lambda x: jnp.sin(x) * x**2 + 1 / (2 + x[::-1] ** 2),
    "rows": lambda x: jnp.sum(x.reshape(4, 3)[ROWS] * x[:3], 1),
    "moved": lambda x: jnp.concatenate([jnp.pad(x[2:9:3], (1, 2)), x.reshape(3, 4).T.ravel(), jnp.arange(3.0)]),
    "products": lambda x: jnp.ravel(x.reshape(3, 4) @ (x.reshape(4, 3) * jnp.arange(3.0))),
    "chosen": lambda x: jnp.where(x > 0, jnp.exp(x), x[::-1]),
    "largest": lambda x: jnp.stack([jnp.max(x), jnp.sum(x), jnp.prod(x[:3])]),
    "a loop": lambda x: lax.fori_loop(0, 3, lambda i, y: y * x + x[i], x),
    "a matrix": lambda x: jnp.ravel(jnp.linalg.cholesky(jnp.eye(3) * 9 + jnp.outer(x[:3], x[:3]))),
    "at a place that is found": lambda x: x.at[jnp.argmax(x)].set(x[0] * x[1])[jnp.argmin(x)][None],
    "functions of its own": lambda x: jax.jit(lambda y: _twice(y) * y[0])(x),
    "chosen by one truth": lambda x: lax.select(jnp.sum(x) > 0, jnp.sin(x), x * x[::-1]),
    "one of them chosen": lambda x: jnp.where(x[0] > 0, x[1] * x[2], x[3])[None],
    "held within": lambda x: jnp.clip(x * 2, -1.0, 1.0) + lax.clamp(-x[::-1], x, 0.5 + 0 * x),
    "sums on the way": lambda x: jnp.cumsum(x.reshape(3, 4), 0).ravel() * jnp.cumsum(x[::-1])[::-1],
    "sorted": lambda x: jnp.sort(x) * jnp.arange(12.0),
    "a branch": lambda x: lax.cond(x[0] > 0, jnp.sin, lambda y: y * x[1], x),
    "a scan": lambda x: lax.scan(lambda c, y: (c * y + x[0], c), x[1], x[2:])[1],
    "until it is large": lambda x: lax.while_loop(lambda y: jnp.max(y) < 9, lambda y: y * 1.5 + x**2, jnp.abs(x) + 1),
    "batches of products": lambda x: jnp.einsum("bij,bjk->bki", x.reshape(3, 2, 2), x[::-1].reshape(3, 2, 2)).ravel(),
    "from a table": lambda x: jnp.interp(x, jnp.linspace(-3, 3, 9), jnp.arange(9.0) ** 2),
    "a slice at a place": lambda x: lax.dynamic_slice(x, (jnp.argmax(x),), (3,)) * x[:3],
    "one less than another": lambda x: jnp.maximum(x, x[::-1]) - jnp.minimum(x[0], x) + jnp.abs(x) ** 1.5,
    "lengths": lambda x: jnp.linalg.norm(x.reshape(4, 3), axis=1) - jnp.hypot(x[:4], x[4:8]),
    "repeated": lambda x: jnp.tile(x[:2], 3) * jnp.repeat(x[2:4], 3) - jnp.roll(x, 2)[:6],
    "added at places": lambda x: jnp.zeros(4).at[ROWS].add(x[:5] * x[5:10]),
    "solved": lambda x: jnp.linalg.solve(jnp.eye(3) * 5 + x[:9].reshape(3, 3), x[9:]),
    "constant": lambda x: jnp.arange(4.0),
    "bodies": lambda x: jax.vmap(lambda q: jnp.outer(q[:2], q[2:]).ravel()[1:] * q[0])(x.reshape(3, 4)).ravel(),
}


def example():
    rng = np.random.default_rng(1)
    return jnp.asarray(rng.normal(size=N)), jnp.asarray(rng.normal(size=(N, 5)))


def one_by_one(function, x, directions):
    return jax.vmap(lambda d: jax.jvp(function, (x,), (d,))[1], 1, 1)(directions)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("compiled", [jax.jit, compiler.jit])
def test_equals_one_after_another(name, compiled):
    function = FUNCTIONS[name]
    x, directions = example()
    found = compiled(lambda x, d: along_each(function, x, d))(x, directions)
    np.testing.assert_allclose(found, one_by_one(function, x, directions), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["entrywise", "rows", "products", "bodies", "functions of its own"])
def test_has_derivatives_and_batches(name):
    function = FUNCTIONS[name]
    x, directions = example()
    ours = lambda x, d: jnp.sum(jnp.sin(along_each(function, x, d)))
    theirs = lambda x, d: jnp.sum(jnp.sin(one_by_one(function, x, d)))
    for transform in (lambda f: jax.grad(f, (0, 1)), lambda f: jax.jacfwd(f, (0, 1))):
        for found, wanted in zip(transform(ours)(x, directions), transform(theirs)(x, directions), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-11)
    many = jnp.stack([x, 2 * x, x + 1])
    np.testing.assert_allclose(
        jax.vmap(ours, (0, None))(many, directions), [theirs(y, directions) for y in many], rtol=1e-12
    )
