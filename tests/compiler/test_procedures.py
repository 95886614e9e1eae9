"""Functions that are called at several places and written once: they give what they give as parts of their surroundings."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import compiler
from dae_jax.compiler.jaxprs.equal_functions import EqualFunctions
from dae_jax.compiler.jaxprs.walk import called
from dae_jax.compiler.lower import compiled, written
from dae_jax.compiler.lower.repeated import repeated
from dae_jax.compiler.thresholds import THRESHOLDS

from .fuzz import campaign
from .fuzz.programs import called_twice


A = np.arange(36.0).reshape(6, 6) / 40
X, C = np.linspace(0.1, 0.6, 6), np.ones((6, 6))


@pytest.fixture(autouse=True)
def everything_is_a_procedure(monkeypatch):
    everything = dataclasses.replace(THRESHOLDS, whole=-1, procedure=1)
    monkeypatch.setattr("dae_jax.compiler.lower.repeated.THRESHOLDS", everything)


@jax.jit
def inner(x):
    return jnp.cos(x) + jnp.mean(jnp.sin(x))


@jax.jit
def several(x, y, c, n):
    """Results of few numbers and of many, known ones, an unused argument, a loop, and calls within."""
    z = jnp.sin(x) * jnp.cos(y) + A @ inner(x) / 10
    w = jax.lax.fori_loop(0, n % 4 + 1, lambda i, w: w + jnp.cos(w) * z / 10, inner(z))
    return z.sum() > 1, w, jnp.zeros(3), jnp.sin(jnp.outer(x, w) + c), n + 1


def main(x, c, n):
    a, b, zeros, m, n = several(x, 2 * x, c, n)
    _, b2, _, m2, n = several(b, np.ones(6), c.T, n)
    wide = jnp.stack([c, c + 1])
    picked = jax.lax.dynamic_index_in_dim(wide, n % 2, 0, keepdims=False)
    branch = jax.lax.cond(a, lambda: several(b2, b, m + m2, n), lambda: several(b, b2, picked, n))
    return b + b2, branch[1], m[::2], m2, branch[3], zeros, n


def test_equals_xla_alone_and_in_lanes():
    text = written(jax.make_jaxpr(main)(X, C, 3))
    assert text.count("define internal") >= 2
    assert text.count("call fastcc") >= 4
    for found, wanted in zip(compiler.jit(main)(X, C, 3), jax.jit(main)(X, C, 3), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12)
    xs, cs, ns = jnp.outer(jnp.arange(-9, 10), X) / 4, jnp.stack([C * k for k in range(19)]), jnp.arange(19)
    batch = jax.jit(jax.vmap(compiler.jit(main), (0, 0, 0)))(xs, cs, ns)
    for found, wanted in zip(batch, jax.jit(jax.vmap(main))(xs, cs, ns), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12)


def test_nothing_is_written_in_place_that_is_needed():
    """With memory used twice and without."""
    jaxpr = jax.make_jaxpr(main)(X, C, 3)
    for lanes in ((), (True, False, True)):
        assert written(jaxpr, lanes, always_copies=True) != written(jaxpr, lanes)
    for lead in ((), (11,)):
        args = np.broadcast_to(X, (*lead, 6)) + 0.0, C, np.zeros(lead, int) + 3
        axes = (0, None, 0)
        ends = []
        for copies in (False, True):
            fn = compiled(jaxpr, (True, False, True) if lead else (), copies)
            ends.append(jax.jit(fn)(*args))
        for a, b in zip(*ends, strict=True):
            np.testing.assert_array_equal(a, b)
        plain = jax.vmap(main, axes) if lead else main
        np.testing.assert_allclose(ends[0][0], plain(*args)[0], rtol=1e-11)


def test_arrays_of_a_procedure_that_the_stack_is_too_small_for():
    @jax.jit
    def large(x):
        grid = jnp.sin(jnp.linspace(0.0, 3.0, 400) * x)
        return jnp.cumsum(grid)[::-1] + jax.lax.fori_loop(0, 3, lambda i, g: g + jnp.roll(g, 1) / 2, grid)

    fn = lambda x: large(x) + large(x + 1) * large(jnp.sin(large(x)[0]))
    np.testing.assert_allclose(compiler.jit(fn)(0.3), jax.jit(fn)(0.3), rtol=1e-11)
    xs = jnp.linspace(0, 1, 13)
    np.testing.assert_allclose(jax.vmap(compiler.jit(fn))(xs), jax.vmap(fn)(xs), rtol=1e-10, atol=1e-11)


def test_complex_numbers_and_derivatives():
    @jax.jit
    def wave(z, k):
        return z * jnp.exp(1j * k) + jnp.conj(z)[::-1]

    fn = lambda k: jnp.real(jnp.sum(wave(wave(jnp.ones(30) + 1j, k), 2 * k) * jnp.arange(30)))
    np.testing.assert_allclose(compiler.jit(fn)(0.4), fn(0.4), rtol=1e-13)
    np.testing.assert_allclose(jax.grad(compiler.jit(fn))(0.4), jax.grad(fn)(0.4), rtol=1e-12)


def test_one_procedure_for_what_is_known_too():
    """And for arguments of the kernel, where it has been written for other numbers."""

    @jax.jit
    def wave(x, y):
        return jnp.sin(x) * y + jnp.cos(y)

    def fn(x, y):
        return wave(jnp.sin(x), 2 * y) + 3 * wave(x, np.arange(6.0)) + wave(np.full(6, -0.0), y)

    assert written(jax.make_jaxpr(fn)(X, X)).count("define internal") == 1
    np.testing.assert_allclose(compiler.jit(fn)(X, X + 1), fn(X, X + 1), rtol=1e-13)
    xs = jnp.outer(jnp.arange(-3, 8), X)
    np.testing.assert_allclose(jax.vmap(compiler.jit(fn), (0, None))(xs, X), jax.vmap(fn, (0, None))(xs, X), rtol=1e-13)


def test_only_what_is_called_again_and_is_large(monkeypatch):
    jaxpr = jax.make_jaxpr(main)(X, C, 3)
    assert len(repeated(jaxpr)) > 1
    assert len(repeated(jax.make_jaxpr(lambda x: several(x, x, C, 1))(X))) == 1
    monkeypatch.setattr("dae_jax.compiler.lower.repeated.THRESHOLDS", dataclasses.replace(THRESHOLDS, procedure=10**6))
    assert not repeated(jaxpr)


def functions_of(*fns):
    """How many different functions are called by one that calls them all."""
    call_all = lambda x, y: [jax.jit(fn)(x, y) for fn in fns]
    found = EqualFunctions()(jax.make_jaxpr(call_all)(X, X + 1))
    calls = [eqn for eqn in found.jaxpr.eqns if called(eqn) is not None]
    assert len(calls) == len(fns)
    for a, b in zip(jax.core.eval_jaxpr(found.jaxpr, found.consts, X, X + 1), call_all(X, X + 1), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    return len({id(eqn.params["call_jaxpr"]) for eqn in calls})


def test_equal_functions_are_one():
    """But for their names, the order of arguments and equations, what is not used, and constants with the same numbers."""
    less, more = (lambda x, y: jnp.sin(x) - jnp.cos(y)), (lambda x, y: jnp.sin(y) - jnp.cos(x))

    def other_order(x, y):
        z, _unused = jnp.cos(y), jnp.exp(x)
        return jnp.sin(x) - z

    assert functions_of(less, more, other_order) == 1
    constant = lambda a: lambda x, y: jax.jit(lambda x: x @ np.array(a))(y) + x
    assert functions_of(constant(A), constant(A + 0), constant(A.copy())) == 1
    looped = lambda n: lambda x, y: jax.lax.fori_loop(0, n, lambda i, z: jnp.sin(z) + y, x)
    assert functions_of(looped(4), looped(4), looped(5)) == 2


def test_what_differs_is_not_one():
    assert functions_of(lambda x, y: x * 0.0, lambda x, y: x * -0.0) == 2
    assert functions_of(lambda x, y: x - x.sum() + y, lambda x, y: y - x.sum() + x) == 2
    assert functions_of(lambda x, y: x + jnp.ones(6), lambda x, y: x + jnp.ones(6, int)) == 2
    assert functions_of(lambda x, y: jnp.flip(x + y), lambda x, y: jnp.roll(x + y, 1)) == 2
    constant = lambda a: lambda x, y: x @ np.array(a)
    assert functions_of(constant(A), constant(A + 1e-16), constant(-A)) == 3


@pytest.mark.parametrize("part", range(2))
def test_programs_at_random(part):
    """One in four of those that are always the same, each called twice."""
    programs = [called_twice(p) for k, p in enumerate(campaign.fixed()) if k % 8 == 4 * part]
    differing = [line for bundle in campaign.bundles(programs) for line in campaign.report(bundle)]
    assert not differing, "\n\n".join(differing)
