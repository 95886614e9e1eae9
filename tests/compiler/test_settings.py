"""The switches: what they take, and what they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler import one_kernel
from dae_jax.compiler.lower import module
from dae_jax.compiler.settings import THREADS, configure, current, read
from tests.compiler.samples import X, in_a_program, is_native, numbered


class TestSettings:
    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"compiler": "gcc"}, "`compiler` must be one of llvm, xla, off, but is 'gcc'"),
            ({"threads": 0}, "`threads` must be a number of threads of at least 1, but is 0"),
            ({"threads": "2"}, "`threads`"),
            ({"isa": "mmx"}, "`isa` must be one of sse2, avx2, avx512, but is 'mmx'"),
            ({"check": "yes"}, "`check`"),
            ({"optimise": 2}, "`optimise` must be true or false, 1 or 0, but is 2"),
            ({"dump": "/proc/nowhere"}, "`dump` must be a folder"),
            ({"compiler": "llvm", "one_kernel": False}, "contradicts"),
        ],
    )
    def test_wrong_values(self, given, words):
        with pytest.raises(ValueError, match=words):
            configure(**given)

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"DAE_JAX_COMPILER": "gcc"}, "DAE_JAX_COMPILER must be one of"),
            ({"DAE_JAX_THREADS": "many"}, "DAE_JAX_THREADS must be a whole number, but is 'many'"),
            ({"DAE_JAX_THREADS": "0"}, "at least 1"),
            ({"DAE_JAX_CHECK": "yes"}, "DAE_JAX_CHECK"),
            ({"DAE_JAX_OPTIMISE": "3"}, "DAE_JAX_OPTIMISE must be true or false, 1 or 0, but is 3"),
            ({"DAE_JAX_ISA": "mmx"}, "DAE_JAX_ISA"),
        ],
    )
    def test_wrong_variables(self, given, words):
        with pytest.raises(ValueError, match=words):
            read(given)

    def test_variables(self, tmp_path):
        given = {
            "COMPILER": "xla",
            "CHECK": "1",
            "DUMP": str(tmp_path / "new"),
            "ISA": "avx2",
            "THREADS": "3",
            "OPTIMISE": "0",
        }
        settings, threads = read({f"DAE_JAX_{name}": value for name, value in given.items()})
        found = settings.compiler, settings.check, settings.isa, settings.optimise, threads
        assert found == ("xla", 4096, "avx2", False, 3)
        assert (tmp_path / "new").is_dir()
        assert read({})[0].compiler == "llvm"
        assert read({"DAE_JAX_CHECK": "0"})[0].check == 0
        assert read({"DAE_JAX_CHECK": "77"})[0].check == 77

    def test_they_end_with_the_statement(self):
        before = THREADS.value
        with configure(compiler="xla", threads=1), configure(check=True):
            assert (current().compiler, current().check, THREADS.value) == ("xla", 4096, 1)
        assert (current().compiler, current().check, THREADS.value) == ("llvm", 0, before)

    def test_who_compiles(self):
        """The same function, compiled before, is compiled again by another compiler."""
        fn = one_kernel(numbered(400.0)[0], "forward")
        call = jax.jit(fn)
        expected = call(X)
        assert is_native(call, X)
        for compiler, mark in (("xla", "xla_cpu_small_call"), ("off", "stablehlo")):
            with configure(compiler=compiler):
                text = call.lower(X).as_text()
                assert "@dae_jax_" not in text
                assert mark in text
                np.testing.assert_allclose(call(X), expected, rtol=1e-14)
        assert is_native(call, X)

    def test_machine_code_that_is_ready_soon(self, tmp_path):
        """The same function, compiled again: LLVM's passes leave it as it is written."""
        call = jax.jit(one_kernel(numbered(450.0)[0], "forward"))
        expected = call(X)
        with configure(optimise=False, dump=tmp_path):
            np.testing.assert_allclose(call(X), expected, rtol=1e-14)
        (written,) = (f for f in tmp_path.iterdir() if f.name.partition(".")[2] == "ll")
        count = lambda text: text.count("= getelementptr ")
        assert count(written.with_suffix(".optimised.ll").read_text()) == count(written.read_text())

    def test_in_the_environment(self):
        program = "print('@dae_jax_' in jax.jit(one_kernel(loop, 'forward')).lower(1.5).as_text())"
        assert in_a_program(program, DAE_JAX_COMPILER="xla") == "False"

    def test_dump(self, tmp_path):
        with configure(dump=tmp_path):
            jax.jit(one_kernel(numbered(500.0)[0], "forward"))(X)
        found = {f.name.partition(".")[2]: f.read_text() for f in tmp_path.iterdir()}
        assert set(found) == {"jaxpr", "ll", "optimised.ll", "s"}
        assert "scan" in found["jaxpr"]
        assert "define i32 @dae_jax_" in found["ll"]
        assert ".globl" in found["s"]


class TestCheck:
    def test_what_is_right_passes(self):
        with configure(check=True):
            fn = one_kernel(lambda x: (numbered(600.0)[0](x), jnp.argmax(x), x > 0, x / 0 * 0), "forward")
            one, batch = jax.jit(fn)(X), jax.jit(jax.vmap(fn))(np.stack([X, -X]))
        np.testing.assert_array_equal(one[1], 1)
        np.testing.assert_array_equal(batch[1], [1, 2])
        assert np.isnan(one[3]).all()

    @pytest.mark.parametrize(
        ("x", "wrong", "words"),
        [
            (X, ("fmul", "fadd"), "float64 array of shape \\(3,\\)"),
            (X.astype(int), ("mul", "add"), "3 and 6|in 3 of 3"),
        ],
    )
    def test_a_wrong_instruction_is_found(self, x, wrong, words, monkeypatch):
        right = module.register
        before, after = (f" = {code} " for code in wrong)

        def mutated(text, *args):
            assert before in text
            return right(text.replace(before, after), *args)

        monkeypatch.setattr(module, "register", mutated)
        with configure(check=True), pytest.raises(Exception, match=words):
            jax.block_until_ready(jax.jit(one_kernel(lambda x: x * 3, "forward"))(x))
