"""Other instruction sets and machines than the one that the tests run on."""

import ctypes
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler import one_kernel
from dae_jax.compiler.emit import object_code, runtime, target
from dae_jax.compiler.emit.vector_math import vector_function
from dae_jax.compiler.lower.module import written
from dae_jax.compiler.settings import configure
from tests.compiler.samples import X, slow


class TestTargets:
    def test_fewer_instructions_the_same_numbers(self):
        fn = lambda x: (slow(x), jnp.exp(x) * jnp.log1p(x * x), jnp.where(x > 0, x, -x) ** 3)
        xs = np.linspace(-2, 2, 101)
        expected = jax.vmap(fn)(xs)
        widths = []
        for isa, width in zip(target.ISAS, (2, 4, 8), strict=True):
            if width > target.vector_size():
                continue
            with configure(isa=isa):
                assert target.vector_size() == width
                widths.append(width)
                text = jax.jit(jax.vmap(one_kernel(fn, "forward"))).lower(xs).as_text()
                assert "@dae_jax_" in text
                for x, y in zip(jax.jit(jax.vmap(one_kernel(fn, "forward")))(xs), expected, strict=True):
                    np.testing.assert_allclose(x, y, rtol=1e-13)
        assert widths[-1] == target.vector_size()

    def test_the_same_function_is_written_for_each(self):
        jaxpr = jax.make_jaxpr(slow)(1.0)
        wide = written(jaxpr, (True,))
        with configure(isa="sse2"):
            assert "<2 x double>" in written(jaxpr, (True,))
        assert written(jaxpr, (True,)) == wide
        assert f"<{target.vector_size()} x double>" in wide

    def test_sse2_has_nothing_of_avx(self, tmp_path):
        with configure(isa="sse2", dump=tmp_path):
            jax.jit(jax.vmap(one_kernel(slow, "forward")))(np.linspace(0, 1, 11))
        (assembly,) = (f.read_text() for f in tmp_path.iterdir() if f.suffix == ".s")
        assert "xmm" in assembly
        assert "ymm" not in assembly
        assert "zmm" not in assembly

    def test_more_than_the_machine_has_is_refused(self, monkeypatch):
        binding = target.llvm()
        found = type(binding.get_host_cpu_features())({"avx2": True})
        monkeypatch.setattr(binding, "get_host_cpu_features", lambda: found)
        target._host.cache_clear()
        try:
            with configure(isa="avx512"), pytest.raises(ValueError, match="this machine has avx2"):
                target.host()
        finally:
            target._host.cache_clear()

    OTHERS = {  # noqa: RUF012
        "aarch64-unknown-linux-gnu": target.Target("aarch64-unknown-linux-gnu", "generic", "", 2),
        "arm64-apple-macosx13.0": target.Target("arm64-apple-macosx13.0", "apple-m1", "", 2),
        "x86_64-apple-macosx13.0": target.Target("x86_64-apple-macosx13.0", "x86-64-v3", "", 4),
    }

    @pytest.mark.parametrize("triple", OTHERS)
    @pytest.mark.parametrize("lanes", [False, True])
    def test_other_machines(self, triple, lanes, monkeypatch):
        """What is written for them is verified, becomes an object file, and calls nothing that was not looked up."""
        other = self.OTHERS[triple]
        binding = target.llvm()
        binding.initialize_all_targets()
        binding.initialize_all_asmprinters()
        try:
            binding.Target.from_triple(triple)
        except RuntimeError:
            pytest.skip(f"LLVM was built without {triple}")
        from dae_jax.compiler.emit import vector_math
        from dae_jax.compiler.lower import instructions, module
        from dae_jax.compiler.lower.rules import floats

        asked = set()

        def looked_up(name):
            if "apple" in triple and name.startswith("sched_"):
                return False
            asked.add(name)
            return True

        monkeypatch.setattr(vector_math, "host", lambda: other)
        monkeypatch.setattr(instructions, "vector_size", lambda: other.width)
        monkeypatch.setattr(floats, "has_symbol", looked_up)
        monkeypatch.setattr(runtime, "has_symbol", looked_up)
        table = lambda x: (jnp.arange(400.0) * x[0]).at[3].set(jnp.cbrt(x[1]))
        jaxpr = jax.make_jaxpr(lambda x: (slow(x), jnp.power(x[0], x[1]), table(x)))(X)
        text = module._written.__wrapped__(jaxpr, (True,) if lanes else (), False, other).replace("{name}", "f")
        assert "_ZGV" not in text or "linux" in triple
        own = {"malloc", "free", runtime.SHARE, runtime.HANDLE, "memset", "memcpy", "memmove", "bzero"}
        for module_text, passes in ((text, True), (runtime.text(), False), (runtime.stubs(), False)):
            code = object_code.object_code(object_code.verified(module_text, other, passes))
            assert len(code) > 500
            declared = set(re.findall(r"^declare \S+ @([\w.]+)", module_text, re.MULTILINE))
            called = {name for name in declared if not name.startswith("llvm.")}
            assert called <= own | asked

    def test_vector_functions_are_those_of_the_machine(self):
        assert self.OTHERS["aarch64-unknown-linux-gnu"].vector_abi == "n"
        assert self.OTHERS["arm64-apple-macosx13.0"].vector_abi is None
        assert target.Target("x86_64-unknown-linux-gnu", "", "", 8).vector_abi == "e"
        name = vector_function("sin", 1)
        assert name is None or hasattr(ctypes.CDLL("libmvec.so.1"), name)
