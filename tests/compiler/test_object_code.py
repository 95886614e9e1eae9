"""Object code that is kept: in memory within a bound, on disk where nobody else can write."""

import ctypes
import os
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from dae_jax.compiler import one_kernel
from dae_jax.compiler.emit import object_cache, object_code, programs, register, self_test, target
from dae_jax.compiler.lower.module import written
from dae_jax.compiler.settings import configure
from tests.compiler.samples import X, numbered


@pytest.mark.parametrize(("often", "limit"), [(True, "LONG"), (False, "LONG_LOOK")])
def test_what_is_long_is_compiled_in_the_least_time(monkeypatch, often, limit):
    module, asked, compiled = written(jax.make_jaxpr(lambda x: x * 19)(X)), [], programs.compiled

    def noted(text, target, optimise=True):
        asked.append(optimise)
        return compiled(text, target, optimise)

    programs.runtime()
    monkeypatch.setattr(programs, "compiled", noted)
    with configure(optimise=True):
        for more in (2, 1):
            monkeypatch.setattr(programs, limit, module.count("\n") + more)
            # As a program of its own.
            register(f"; {often} {more}\n{module}", often=often)
    assert asked == [True, False]


class TestLeastRecentlyUsed:
    def test_code_is_let_go_and_comes_back(self, monkeypatch):
        calls = []
        for k in range(6):
            fn, _ = numbered(100.0 + k)
            call = jax.jit(one_kernel(fn, "forward")).lower(X).compile()
            calls.append((call, np.asarray(fn(X))))
            np.testing.assert_allclose(call(X), calls[-1][1], rtol=1e-14)
        own = list(programs._programs.values())[-6:]
        monkeypatch.setattr(programs, "BOUND", 2 * (own[0].size + programs.ENGINE))
        for call, expected in calls * 3:
            np.testing.assert_allclose(call(X), expected, rtol=1e-14)
            jax.jit(one_kernel(numbered(time.monotonic())[0], "forward"))(X)
            loaded = [p for p in programs._programs.values() if p.engine is not None]
            assert sum(p.size + programs.ENGINE for p in loaded) <= programs.BOUND or len(loaded) == 1

    def test_the_last_used_stay(self, monkeypatch):
        calls = [jax.jit(one_kernel(numbered(200.0 + k)[0], "forward")).lower(X).compile() for k in range(3)]
        for call in calls:
            jax.block_until_ready(call(X))
        own = list(programs._programs.values())[-3:]
        jax.jit(one_kernel(numbered(210.0)[0], "forward"))(X)
        jax.block_until_ready(calls[0](X))
        monkeypatch.setattr(programs, "BOUND", int(3.5 * (own[0].size + programs.ENGINE)))
        jax.jit(one_kernel(numbered(211.0)[0], "forward"))(X)
        assert own[0].engine is not None
        assert own[1].engine is None
        assert own[2].engine is None

    def test_what_is_running_is_kept(self):
        """A call that is counted keeps the code, whoever wants it gone."""
        name = register(written(jax.make_jaxpr(lambda x: x * 17)(X)))
        program = programs._programs[name]
        assert program.engine is None
        assert programs._fetch(program.slot)
        running = ctypes.c_int64.from_address(program.slot + 8)
        running.value += 1
        assert not programs.runtime().release(program.slot)
        running.value -= 1
        assert programs.runtime().release(program.slot)
        programs.runtime().fill(program.slot, program.engine.get_function_address(f"{name}.kernel"))

    def test_code_that_cannot_be_made_is_an_error_of_the_call(self, monkeypatch, caplog):
        """As LLVM says it; a module that is broken has been refused before."""

        def fails(_):
            raise RuntimeError("LLVM makes no machine code of a module: for a reason of its own")

        assert self_test.available()
        fn, _ = numbered(407.0)
        with monkeypatch.context() as patch:
            patch.setattr(programs, "object_code", fails)
            with pytest.raises(jax.errors.JaxRuntimeError, match="could not be loaded"):
                jax.block_until_ready(jax.jit(one_kernel(fn, "forward"))(X))
        assert "for a reason of its own" in caplog.text
        # The same function is tried anew.
        np.testing.assert_allclose(jax.jit(one_kernel(fn, "forward"))(X), fn(X), rtol=1e-14)

    def test_threads_that_call_what_others_let_go(self, monkeypatch):
        monkeypatch.setattr(programs, "BOUND", 1)
        calls = []
        for k in range(8):
            fn, _ = numbered(300.0 + k)
            calls.append((jax.jit(one_kernel(fn, "forward")).lower(X).compile(), np.asarray(fn(X))))

        def work(k):
            for _ in range(40):
                np.testing.assert_allclose(calls[k][0](X), calls[k][1], rtol=1e-14)

        with ThreadPoolExecutor(8) as pool:
            list(pool.map(work, range(8)))


@pytest.fixture
def cache(tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / "dae_jax"
    jax.config.update("jax_compilation_cache_dir", before)


class TestObjectCodeOnDisk:
    TEXT = "define i64 @f() {\nret i64 7\n}"

    def test_it_is_kept_and_taken(self, cache, monkeypatch):
        code = programs.compiled(self.TEXT, target.host()).result()
        (file,) = cache.iterdir()
        assert file.stat().st_mode & 0o777 == 0o600
        assert cache.stat().st_mode & 0o777 == 0o700
        monkeypatch.setattr(programs, "object_code", lambda *_: pytest.fail("compiled again"))
        assert programs.compiled(self.TEXT, target.host()).result() == code

    @pytest.mark.parametrize(
        "harm", [lambda b: b[:-1], lambda b: b[:99] + b"x" + b[100:], lambda b: b"", lambda b: b[20:]]
    )
    def test_a_damaged_file_is_compiled_again(self, cache, harm):
        code = programs.compiled(self.TEXT, target.host()).result()
        (file,) = cache.iterdir()
        whole = file.read_bytes()
        file.write_bytes(harm(whole))
        assert programs.compiled(self.TEXT, target.host()).result() == code
        assert file.read_bytes() == whole

    @pytest.mark.parametrize("mode", [0o777, 0o770, 0o720])
    def test_a_folder_that_others_can_write_to_is_not_used(self, cache, mode):
        programs.compiled(self.TEXT, target.host()).result()
        (file,) = cache.iterdir()
        cache.chmod(mode)
        assert object_cache.load(file.stem) is None
        cache.chmod(0o700)
        assert object_cache.load(file.stem)
        file.chmod(0o666)
        assert object_cache.load(file.stem) is None

    def test_links_are_not_followed(self, cache, tmp_path):
        programs.compiled(self.TEXT, target.host()).result()
        (file,) = cache.iterdir()
        moved = file.rename(tmp_path / "moved.o")
        file.symlink_to(moved)
        assert object_cache.load(file.stem) is None
        file.unlink()
        moved.rename(file)
        folder = cache.rename(tmp_path / "elsewhere")
        cache.symlink_to(folder)
        assert object_cache.load(file.stem) is None

    def test_what_the_key_depends_on(self, monkeypatch):
        def key(text="text", optimise=True):
            return object_code.key(text, target.host(), optimise)

        first = key()
        assert key("other") != first
        assert key(optimise=False) != first
        for owner, name, value in (
            (object_code, "SPEED", 3), (object_code, "TUNING", {}), (object_code, "HEAVY", 1),
            (object_code, "VERSION", (0, 4)), (object_code.importlib.metadata, "version", lambda _: "9.9"),
        ):  # fmt: skip
            with monkeypatch.context() as patch:
                patch.setattr(owner, name, value)
                assert key() != first, name
        with configure(isa="sse2"):
            assert key() != first

    def test_there_is_a_bound(self, cache, monkeypatch):
        monkeypatch.setattr(object_cache, "BOUND", 2500)
        for k in range(5):
            object_cache.keep(f"key{k}", bytes(1000))
            os.utime(cache / f"key{k}.o", (k, k))
        assert sorted(f.name for f in cache.iterdir()) == ["key3.o", "key4.o"]

    def test_no_cache_no_file(self, monkeypatch):
        monkeypatch.setitem(jax.config.values, "jax_compilation_cache_dir", None)
        assert object_cache._folder() is None
