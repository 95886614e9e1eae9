"""What differs from lane to lane is found once for each function that a program has, however deep its loops are."""

import functools

import jax
import jax.numpy as jnp
import pytest

from dae_jax.compiler.lower import uniformity


def nested(depth, x):
    """Loops in loops; each carries a number that is the same in all lanes and becomes different at the second turn."""
    if depth == 0:
        return jnp.sin(x[0]), x[0] * x[1]
    return jax.lax.fori_loop(0, 3, lambda i, y: nested(depth - 1, (y[1] + i, y[0])), x)


@pytest.mark.parametrize("depth", [2, 5, 8])
def test_work_grows_with_the_depth_and_not_as_a_power(monkeypatch, depth):
    looked, within = [], uniformity._varying
    monkeypatch.setattr(uniformity, "_varying", lambda *args: looked.append(args) or within(*args))
    closed = jax.make_jaxpr(functools.partial(nested, depth))((1.0, 2.0))
    assert uniformity.varying(closed, [True, False]) == [True, True]
    # Two inputs, a body and a condition for each loop; each with few combinations of what differs.
    assert 0 < len(looked) < 40 * depth


def test_what_is_known_of_other_inputs_is_not_taken():
    closed = jax.make_jaxpr(lambda x, y: (jax.jit(jnp.sin)(x), jax.jit(jnp.sin)(y)))(1.0, 2.0)
    assert uniformity.varying(closed, [True, False], False) == [True, False]
    assert uniformity.varying(closed, [False, True], False) == [False, True]
    assert uniformity.varying(closed, [False, False], False) == [False, False]
