"""Functions on the host that a kernel calls: in the lanes that ask for them, with the arrays of each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import compiler


class Sorted:
    """Sorts, and remembers what."""

    never_raises = True

    def __init__(self):
        self.seen = []

    def __call__(self, x):
        self.seen.append(np.array(x))
        return np.sort(x)


def called(fn, x):
    return jax.pure_callback(fn, jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="sequential")


@pytest.mark.parametrize("dtype", ["float64", "float32", "complex128", "int16", "bool"])
@pytest.mark.parametrize("size", [3, 300])
def test_alone_and_in_a_batch(dtype, size):
    fn = Sorted()
    kernel = compiler.jit(lambda x: called(fn, x)[::-1])
    x = np.random.default_rng(0).normal(size=(21, size)) * 4
    x = (x + 1j * x[::-1] if dtype == "complex128" else x > 0 if dtype == "bool" else x).astype(dtype)
    assert kernel.lower(x[0]).compiler == "llvm"
    np.testing.assert_array_equal(kernel(x[0]), np.sort(x[0])[::-1])
    np.testing.assert_array_equal(jax.vmap(kernel)(x), np.sort(x, 1)[:, ::-1])


def test_in_the_lanes_that_take_the_branch():
    fn = Sorted()

    def loop(x):
        # Lane k is sorted k times.
        body = lambda k, y: jax.lax.cond(k < x[0], lambda: called(fn, y) - 1, lambda: y)
        return jax.lax.fori_loop(0, 9, body, x)

    x = np.stack([np.array([k, 50.0 + k, 20.0, 30.0]) for k in range(8)])
    found = np.asarray(jax.vmap(compiler.jit(loop))(x))
    for k, row in enumerate(found):
        np.testing.assert_array_equal(row, np.sort(x[k]) - k if k else x[0])
    assert len(fn.seen) == sum(range(8))


def test_what_may_raise_is_left_to_xla():
    kernel = compiler.jit(lambda x: called(np.sort, x))
    lowered = kernel.lower(np.ones(3))
    assert lowered.compiler != "llvm"
    assert "may raise" in str(lowered.unsupported)


def test_what_raises_all_the_same_is_no_number(monkeypatch):
    said = []
    monkeypatch.setattr("sys.unraisablehook", lambda found: said.append(found.exc_type))

    def fn(x):
        raise ValueError

    fn.never_raises = True
    assert np.isnan(compiler.jit(lambda x: called(fn, x))(np.ones(3))).all()
    assert said == [ValueError]


def test_equal_functions_have_one_place():
    """So that tracing again keeps nothing more."""
    from dae_jax.compiler.emit import host_functions

    fn, kept = Sorted(), []
    for _ in range(3):
        compiler.jit(lambda x: called(fn, x))(np.ones(5))
        kept.append(len(host_functions._calls))
    assert kept[0] == kept[1] == kept[2]
    compiler.jit(lambda x: called(Sorted(), x))(np.ones(5))
    assert len(host_functions._calls) == kept[0] + 1


def test_the_derivative_goes_around_it():
    """Of a linear solve that a function on the host does."""

    def inverse(a, b):
        return np.linalg.solve(a, b)

    inverse.never_raises = True
    shape = jax.ShapeDtypeStruct((4,), np.dtype(float))
    host = lambda a, b: jax.pure_callback(inverse, shape, a, b, vmap_method="sequential")

    @compiler.jit
    def solve(a, b):
        kept = jax.lax.stop_gradient(a)
        return jax.lax.custom_linear_solve(
            lambda x: a @ x, b, solve=lambda _, b: host(kept, b), transpose_solve=lambda _, b: host(kept.T, b)
        )

    a, b = np.eye(4) * 5 + np.random.default_rng(0).normal(size=(4, 4)), jnp.arange(4.0)
    loss = lambda f: lambda a: jnp.sum(f(a, b) ** 2)
    np.testing.assert_allclose(jax.grad(loss(solve))(a), jax.grad(loss(jnp.linalg.solve))(a), rtol=1e-10)
