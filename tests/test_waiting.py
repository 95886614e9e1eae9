"""What keeps the first answer from being waited for: what is compiled, by whom, and that it is said."""

import jax
import jax.numpy as jnp
import numpy as np

from dae_jax.kernels import xla_kernel
from dae_jax.kernels.native import compiled, compiler, hindrances, machine
from dae_jax.kernels.native.extent import extent


X = np.array([1.0, 2.0, -3.0])


def repeated(x, count):
    for _ in range(count):
        x = jnp.sin(x) + x[::-1]
    return x


class TestExtent:
    def test_what_moves_entries_takes_nothing(self):
        moving = jax.make_jaxpr(lambda x: jnp.stack([x[::-1], x]).T.reshape(-1)[2:])(X)
        assert extent(moving, [False])[0] == 0

    def test_what_is_known_is_not_written(self, monkeypatch):
        """The estimate knows of no zeros: between one and four times the limit the function is written to see."""
        monkeypatch.setattr(compiler, "LIMIT", 500)
        jaxpr = jax.make_jaxpr(lambda x: repeated(x, 10) + repeated(jnp.zeros(16), 30))(jnp.arange(16.0))
        assert extent(jaxpr, [False])[0] > compiler.LIMIT
        assert hindrances(jaxpr) == ()
        assert hindrances(jax.make_jaxpr(lambda x: repeated(x, 40))(jnp.arange(16.0))) == ("size",)

    def test_factorials_of_taylor_arithmetic_do_not_hinder(self):
        jaxpr = jax.make_jaxpr(lambda x: x * jax.lax.exp(jax.lax.lgamma(4.0)))(X)
        assert hindrances(jaxpr) == ()
        np.testing.assert_allclose(compiled(jaxpr)(X)[0], 6 * X, rtol=1e-15)
        assert hindrances(jax.make_jaxpr(jax.lax.lgamma)(X)) == ("lgamma",)


class TestCheaperForms:
    def test_a_large_module_is_compiled_without_passes(self, monkeypatch):
        monkeypatch.setattr(machine, "HEAVY", 0)
        monkeypatch.setattr(machine, "_optimise", lambda _: (_ for _ in ()).throw(AssertionError("passes were run")))
        found = compiled(jax.make_jaxpr(lambda x: jnp.sum(jnp.sin(x) * jnp.cos(x)) + 0.731)(X))(X)
        np.testing.assert_allclose(found[0], np.sum(np.sin(X) * np.cos(X)) + 0.731, rtol=1e-14)

    def test_xla_makes_no_single_kernel_of_a_large_function(self, monkeypatch):
        jaxpr = jax.make_jaxpr(lambda x: repeated(x, 20))(X)
        assert xla_kernel.qualifies(jaxpr)
        monkeypatch.setattr(xla_kernel, "LIMIT", 30)
        assert xla_kernel.hindrances(jaxpr) == ("size",)
        assert not xla_kernel.qualifies(jaxpr)
