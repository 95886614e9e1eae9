"""What the package leans on without being promised it: where a new version of a dependency breaks one of these, the rest follows."""

import logging

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax import RESULTS, _compat
from dae_jax.compiler import _compat as of_compiler


class TestPackage:
    def test_the_default_tolerances_of_an_implicit_solver(self):
        """diffrax marks tolerances that are those of the step-size controller; they are replaced by ours."""
        finder = diffrax.Kvaerno5().root_finder
        assert finder.rtol is _compat.use_stepsize_tol
        assert finder.atol is _compat.use_stepsize_tol

    def test_any_of_a_batch(self):
        """The condition of a batch, which stays one number under `vmap`."""
        seen = jax.vmap(lambda x: _compat.unvmap_any(x) & jnp.array(True), axis_size=3)(jnp.array([False, True, False]))
        np.testing.assert_array_equal(seen, [True, True, True])
        jaxpr = jax.make_jaxpr(jax.vmap(lambda x: jax.lax.cond(_compat.unvmap_any(x), lambda: 1, lambda: 2)))(
            jnp.ones(3, bool)
        )
        assert "cond" in str(jaxpr)

    @pytest.mark.parametrize("kind", ["lax", "checkpointed", "bounded"])
    def test_loops_of_equinox(self, kind):
        most = {} if kind == "lax" else {"max_steps": 16}
        loop = lambda x: _compat.while_loop(
            lambda c: c[0] < 5, lambda c: (c[0] + 1, c[1] * x), (0, x), kind=kind, **most
        )[1]
        assert loop(2.0) == 64.0
        if kind != "lax":
            assert jax.grad(loop)(2.0) == 192.0

    def test_a_loop_without_reverse_derivatives(self):
        turns = lambda x: jax.lax.while_loop(lambda c: c[0] < 5, lambda c: (c[0] + 1, c[1] * x), (0, x))[1]
        with pytest.raises(ValueError, match=r"lax\.while_loop") as refused:
            jax.vjp(turns, 2.0)[1](1.0)
        assert _compat.is_a_loop_without_reverse(refused.value)
        assert not _compat.is_a_loop_without_reverse(ValueError("another"))

    def test_messages_of_results(self):
        assert _compat.messages(RESULTS)[int(RESULTS.successful._value)] == "successful"
        assert "maximum number of solver steps" in _compat.messages(RESULTS)[int(RESULTS.max_steps_reached._value)]
        other = eqx.tree_at(lambda r: r._value, RESULTS.successful, np.asarray(int(RESULTS.max_steps_reached._value)))
        assert other == RESULTS.max_steps_reached

    def test_the_log_of_a_callback_that_raises(self, caplog):
        def fails(x):
            raise ArithmeticError("of a callback")

        with pytest.raises(jax.errors.JaxRuntimeError, match="of a callback"):
            jax.block_until_ready(
                jax.jit(lambda x: jax.pure_callback(fails, jax.ShapeDtypeStruct((), x.dtype), x))(1.0)
            )
        assert _compat.CALLBACK_LOG in {record.name for record in caplog.records}
        assert logging.getLogger(_compat.CALLBACK_LOG).name == _compat.CALLBACK_LOG


class TestCompiler:
    def test_nothing_is_traced_here(self):
        assert of_compiler.trace_state_clean()
        seen = []
        jax.jit(lambda x: seen.append(of_compiler.trace_state_clean()) or x)(1.0)
        assert seen == [False]

    def test_what_is_computed_now(self):
        seen = []

        @jax.jit
        def traced(x):
            with of_compiler.evaluated_now():
                seen.append(float(jnp.sin(jnp.asarray(1.0))))
            return x

        traced(1.0)
        with of_compiler.evaluated_now():
            # What is traced here has its constants in it.
            seen += [eqn.primitive.name for eqn in jax.make_jaxpr(lambda x: x + jnp.arange(3))(1).eqns]
        assert seen[0] == pytest.approx(np.sin(1.0))
        assert "iota" in seen

    def test_outside_of_what_is_traced(self):
        """A program that is called there has its own options, and what a function holds of what is traced is refused."""
        twice = jax.jit(lambda x: 2 * x, compiler_options={"xla_backend_optimization_level": 0})

        def traced(x):
            with of_compiler.eval_context():
                known = float(twice(jnp.asarray(1.5)))
                with pytest.raises(jax.errors.UnexpectedTracerError):
                    jax.jit(lambda y: x * y)(known)
            return known * x

        assert jax.grad(traced)(1.0) == jax.jit(traced)(1.0) == 3.0

    def test_jax_has_started(self):
        jnp.zeros(1).block_until_ready()
        assert of_compiler.backends_are_initialised()

    def test_the_cache_of_compiled_code(self, tmp_path):
        before = jax.config.values["jax_compilation_cache_dir"], jax.config.values["jax_enable_compilation_cache"]
        try:
            jax.config.update("jax_compilation_cache_dir", str(tmp_path))
            assert of_compiler.compilation_cache_folder() == str(tmp_path)
            jax.config.update("jax_enable_compilation_cache", False)
            assert of_compiler.compilation_cache_folder() is None
            jax.config.update("jax_enable_compilation_cache", True)
            jax.config.update("jax_compilation_cache_dir", "gs://bucket")
            assert of_compiler.compilation_cache_folder() is None
        finally:
            jax.config.update("jax_compilation_cache_dir", before[0])
            jax.config.update("jax_enable_compilation_cache", before[1])

    def test_the_call_that_checks(self):
        """What `equinox.error_if` becomes is found, and another callback is none."""
        from dae_jax.compiler import equations

        checked = jax.make_jaxpr(lambda x: eqx.error_if(x, x > 0, "x must not be positive"))(1.0)
        assert any(map(of_compiler.is_check, equations(checked)))
        other = jax.make_jaxpr(lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), x.dtype), x))(jnp.zeros(()))
        assert not any(map(of_compiler.is_check, equations(other)))

    def test_what_is_not_needed_of_a_jaxpr(self):
        jaxpr = jax.make_jaxpr(lambda x, y: (x + 1, y * 2))(1.0, 2.0).jaxpr
        needed, used = of_compiler.dce_jaxpr(jaxpr, [True, False])
        assert used == [True, False]
        assert [eqn.primitive.name for eqn in needed.eqns] == ["add"]
