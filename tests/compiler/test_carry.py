"""What a loop hands on is what it was before the loop's own arrays get their next values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from dae_jax import compiler


LARGE = 30
PIECES = {
    "unstack": lambda x: tuple(jnp.unstack(x)),
    "split": lambda x: tuple(jnp.split(x, 5)),
    "slice": lambda x: (x[3:9], x[-1]),
    "strided": lambda x: (x[1::5],),
    "row": lambda x: (x.reshape(5, 6)[2],),
    "column": lambda x: (x.reshape(5, 6).T[2],),
    "reversed": lambda x: (x[::-1][:4],),
    "window": lambda x: (lax.dynamic_slice(x, (x[0].astype(int) % 3,), (4,)),),
    "repeated": lambda x: (jnp.broadcast_to(x[:2], (3, 2)),),
    "gather": lambda x: (x[jnp.array([3, 1])],),
    "large": lambda x: (x[::-1], x[1:]),
}


def after(pieces):
    """The array is replaced by what is computed of it, and its pieces come after it."""

    def fn(x, count):
        turn = lambda c: (c[0] + 1, jnp.roll(c[1], 1), pieces(c[1]))
        return lax.while_loop(lambda c: c[0] < count, turn, (0, x, pieces(x)))[2]

    return fn


def before(pieces):
    """The pieces come before it."""

    def fn(x, count):
        turn = lambda c: (pieces(c[2]), c[1] + 1, jnp.roll(c[2], 1))
        return lax.while_loop(lambda c: c[1] < count, turn, (pieces(x), 0, x))[0]

    return fn


def in_place(pieces):
    """One entry of it is replaced."""

    def fn(x, count):
        return lax.fori_loop(0, count, lambda i, c: (c[0].at[i].set(7.0), pieces(c[0])), (x, pieces(x)))[1]

    return fn


def scanned(pieces):
    """The pieces of each turn are kept."""

    def fn(x, count):
        return lax.scan(lambda x, _: (jnp.roll(x, count), pieces(x)), x, None, 12)[1]

    return fn


def in_a_branch(pieces):
    """The array is replaced in a branch, or not."""

    def fn(x, count):
        turn = lambda c, i: lax.cond(i < count, lambda x, _: (jnp.roll(x, 1), pieces(x)), lambda x, old: (x, old), *c)
        return lax.fori_loop(0, 6, lambda i, c: turn(c, i), (x, pieces(x)))[1]

    return fn


@pytest.mark.parametrize("pieces", PIECES)
@pytest.mark.parametrize("loop", [after, before, in_place, scanned, in_a_branch])
def test_pieces_of_an_array_that_a_loop_replaces(loop, pieces):
    """Of few entries they are in registers, where the array is in memory. They were read when it had been replaced."""
    before = compiler.left_to_xla()
    fn = loop(PIECES[pieces])
    xs, counts = np.random.default_rng(0).normal(size=(7, LARGE)), np.array([3, 1, 2, 5, 4, 1, 6])
    wanted = jax.jit(jax.vmap(fn))(xs, counts)
    for found in (compiler.jit(jax.vmap(fn))(xs, counts), jax.vmap(compiler.jit(fn))(xs, counts)):
        jax.tree.map(np.testing.assert_array_equal, found, wanted)
    alone = compiler.jit(fn)(xs[0], 3)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[0]), alone, wanted)
    assert compiler.left_to_xla() == before
