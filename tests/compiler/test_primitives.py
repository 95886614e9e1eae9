"""Primitives one by one, as our compiler and as XLA has them: a few numbers in registers, many in memory, and lanes."""

import jax
import numpy as np
import pytest

from dae_jax.compiler.lower import compiled


LAX = jax.lax
LANES = 11


def edges(dtype, shape):
    """Numbers of a type, with its edges among them."""
    rng, dtype = np.random.default_rng(0), np.dtype(dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    if dtype.kind == "f":
        info = np.finfo(dtype)
        special = [0.0, -0.0, np.inf, -np.inf, np.nan, info.max, info.tiny, 1.0, -0.5, 2.5, 300.0]
    else:
        info, bits = np.iinfo(dtype), 8 * dtype.itemsize
        special = [info.min, info.min + 1, info.max, info.max - 1, info.max // 2 + 1, 0, 1, 2, 7, bits - 1, bits]
    ordinary = rng.normal(0, 3, shape) if dtype.kind == "f" else rng.integers(0, 100, shape)
    return np.where(rng.random(shape) < 0.4, rng.choice(np.array(special, dtype), shape), ordinary.astype(dtype))


def same(fn, *args, ulps=0):
    """A function of batched arrays is the same by our compiler, alone and in lanes, and by XLA."""
    wanted = jax.tree.leaves(jax.jit(jax.vmap(fn))(*args))
    jaxpr = jax.make_jaxpr(lambda *xs: jax.tree.leaves(fn(*xs)))(*(x[0] for x in args))
    alone = jax.jit(compiled(jaxpr))(*(x[0] for x in args))
    lanes = jax.jit(compiled(jaxpr, (True,) * len(args)))(*args)
    for a, b, c in zip(alone, lanes, wanted, strict=True):
        assert a.dtype == b.dtype == c.dtype
        for found, expected in ((a, c[0]), (b, c)):
            if ulps:
                np.testing.assert_allclose(found, expected, rtol=ulps * np.finfo(c.dtype).eps, atol=0)
            else:
                np.testing.assert_array_equal(found, expected)
            if np.issubdtype(c.dtype, np.floating):
                np.testing.assert_array_equal(np.signbit(found), np.signbit(expected) | np.signbit(found) * np.isnan(found))


INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]


@pytest.mark.parametrize("dtype", INTEGERS)
def test_bits(dtype):
    def fn(x, y):
        return [LAX.population_count(z) for z in (x, y)]

    same(fn, edges(dtype, (LANES, 5)), edges(dtype, (LANES, 40)))
