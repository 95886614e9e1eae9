"""Programs that run a few times are compiled quickly, and give the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler import quickly, quickly_compiled
from dae_jax.compiler._compat import accepted_options


X = jnp.linspace(0.1, 1.0, 7)


def several(x, power, extra):
    return {"sum": jnp.sum(x**power), "sorted": jnp.sort(jnp.sin(x)), "extra": extra}


def test_gives_the_same_and_what_is_no_array_as_it_is():
    found, expected = quickly_compiled(several)(X, 3, "name"), several(X, 3, "name")
    assert found["extra"] == "name"
    np.testing.assert_allclose(found["sum"], expected["sum"], rtol=1e-14)
    np.testing.assert_allclose(found["sorted"], expected["sorted"], rtol=1e-14)


def test_within_other_programs_it_is_a_part_of_these():
    fn = quickly_compiled(lambda x: jnp.sum(x**3))
    np.testing.assert_allclose(jax.jit(jax.grad(fn))(X), 3 * X**2, rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(fn)(jnp.stack([X, 2 * X])), [fn(X), 8 * fn(X)], rtol=1e-14)
    # What is known is a part of them too.
    np.testing.assert_allclose(jax.jit(lambda: fn(X))(), fn(X), rtol=1e-14)


def test_beside_what_is_traced_numbers_that_are_known_stay_so():
    fn, seen = quickly_compiled(lambda x: jnp.sum(x**3)), []
    fn(X)

    def traced(k):
        seen.append(fn(X))
        return k * seen[-1]

    for derivative in (jax.grad(traced), jax.jit(traced)):
        np.testing.assert_allclose(derivative(1.0), fn(X), rtol=1e-14)
    assert not any(isinstance(x, jax.core.Tracer) for x in seen)


def test_a_function_may_hold_what_is_traced():
    of = quickly_compiled(lambda fn, x: fn(x))
    np.testing.assert_allclose(jax.grad(lambda k: of(lambda x: jnp.sum(k**2 * x), X))(2.0), 4 * jnp.sum(X), rtol=1e-14)


@pytest.fixture
def options_of(monkeypatch):
    """The options of XLA with which each program is compiled."""
    seen = []
    compiled = quickly.eqx.filter_jit
    monkeypatch.setattr(quickly.eqx, "filter_jit", lambda fn, **options: compiled(_noted(fn, options, seen), **options))
    return seen


def _noted(fn, options, seen):
    def noted(*args):
        seen.append(options)
        return fn(*args)

    return noted


def test_only_of_few_numbers_are_optimisations_left_out(options_of, monkeypatch):
    monkeypatch.setattr(quickly, "FEW", X.size)
    fn = quickly_compiled(jnp.sin)
    fn(X)
    fn(jnp.concatenate([X, X]))
    quick, usual = options_of
    assert quick["compiler_options"]["xla_backend_optimization_level"] == 0
    assert usual == {}


def test_an_option_that_this_version_does_not_know_is_left_out():
    known = ("xla_backend_optimization_level", 0)
    assert accepted_options((known, ("xla_no_such_option", 1))) == dict([known])
    # What a new version of XLA drops is to be looked at: JAX 0.12 has one kind of fusion only.
    dropped = {"xla_cpu_use_fusion_emitters"} if jax.__version_info__ >= (0, 12) else set()
    assert accepted_options(quickly._QUICK) == {k: v for k, v in quickly._QUICK if k not in dropped}
