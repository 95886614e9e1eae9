"""Machine code in the process: XLA's interface, memory that is not there, threads, what is kept, forks, other machines."""

import ctypes
import os
import re
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dae_jax.compiler import fallbacks, kernel_call, one_kernel
from dae_jax.compiler.emit import interface, object_cache, object_code, programs, register, runtime, self_test, target
from dae_jax.compiler.emit.vector_math import vector_function
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower.module import written
from dae_jax.compiler.settings import THREADS, configure, current, read


X = np.array([1.0, 2.0, -3.0])


def numbered(seed):
    """A function of its own for each number, and what it gives."""
    return (lambda x: jax.lax.fori_loop(0, 9, lambda i, y: y * 0.5 + seed + jnp.sin(y), x)), seed


def is_native(fn, *args):
    return "@dae_jax_" in jax.jit(fn).lower(*args).as_text()


def slow(x):
    return jax.lax.fori_loop(0, 2000, lambda i, y: y + 0.01 * jnp.sin(y + i), x)


def in_a_program(text, **environment):
    """What a program of its own prints."""
    head = (
        "import os, sys, jax, jax.numpy as jnp, numpy as np\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "from dae_jax.compiler import one_kernel, configure\n"
        "from dae_jax.compiler.emit import programs, available\n"
        "loop = lambda x: jax.lax.fori_loop(0, 500, lambda i, y: y + 0.01 * jnp.sin(y + i), x)\n"
    )
    given = {"JAX_PLATFORMS": "cpu", "PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    done = subprocess.run(
        [sys.executable, "-c", head + text], capture_output=True, text=True, env=given, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def threads_of_the_process():
    return len(os.listdir("/proc/self/task"))


@pytest.fixture(scope="module")
def header():
    text = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()
    text = re.sub(r"//.*", "", text)
    return re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\);", r"void* \1;", text)


class TestInterface:
    """The offsets are those of the header that comes with JAX."""

    SIZES = {"size_t": 8, "int64_t": 8, "int64_t*": 8, "int": 4, "uint32_t": 4}  # noqa: RUF012

    def layout(self, header, name):
        """Offset of each field, alignment, and size."""
        body = re.search(rf"struct {name} {{(.*?)}}", header, re.DOTALL)[1]
        body = re.sub(r"void \(\*(\w+)\)\([^)]*\)", r"void* \1", body)
        offsets, at, widest = {}, 0, 1
        for kind, field in re.findall(r"([\w\s]+?\**)\s*(\w+);", body):
            kind = kind.replace("const ", "").replace("struct ", "").strip()
            size, align = self.size(header, kind)
            at = -(-at // align) * align
            offsets[field], at, widest = at, at + size, max(widest, align)
        return offsets, widest, -(-at // widest) * widest

    def size(self, header, kind):
        if kind.endswith("*"):
            return 8, 8
        if kind in self.SIZES:
            return self.SIZES[kind], self.SIZES[kind]
        if f"}} {kind};" in header and re.search(rf"typedef enum {{[^}}]*}} {kind};", header):
            return 4, 4
        if kind == "XLA_FFI_Handler_Traits":
            return 4, 4
        _, align, size = self.layout(header, kind)
        return size, align

    @pytest.mark.parametrize("name", list(interface.OFFSETS))
    def test_offsets(self, header, name):
        found, *_ = self.layout(header, name)
        for field, at in interface.OFFSETS[name].items():
            if field:
                assert found[field] == at, (name, field)
        last = re.search(rf"XLA_FFI_DEFINE_STRUCT_TRAITS\({name}, (\w+)\)", header)
        if "" in interface.OFFSETS[name]:
            field = last[1] if last else list(found)[-1]
            kind = re.search(rf"struct {name} {{.*?([\w*]+)\s+{field};", header, re.DOTALL)[1]
            assert interface.OFFSETS[name][""] == found[field] + self.size(header, kind)[0]

    def test_numbers(self, header):
        for name, number in interface.NUMBERS.items():
            assert int(re.search(rf"{name} = (\d+)", header)[1]) == number

    def test_version(self, header):
        """Where this fails, look at what changed in the header before changing `VERSION`."""
        found = tuple(int(re.search(rf"XLA_FFI_API_{part} (\d+)", header)[1]) for part in ("MAJOR", "MINOR"))
        assert found >= interface.VERSION
        assert found[0] == interface.VERSION[0]


class TestHandler:
    def answer(self, caller):
        """The version that the handler answers to a caller of another."""
        kernel = programs.handler(register(written(jax.make_jaxpr(lambda x: x * 3)(X))))
        api = (ctypes.c_int32 * 64)(*[0] * 64)
        api[8], api[9] = caller
        metadata = (ctypes.c_int64 * 6)(48)
        extension = (ctypes.c_int64 * 4)(
            32, interface.NUMBERS["XLA_FFI_Extension_Metadata"], 0, ctypes.addressof(metadata)
        )
        frame = (ctypes.c_int64 * 22)(168, ctypes.addressof(extension), ctypes.addressof(api))
        assert not kernel(ctypes.addressof(frame))
        return tuple((ctypes.c_int32 * 2).from_address(ctypes.addressof(metadata) + 24))

    @pytest.mark.parametrize("caller", [(0, 3), (0, 9), (1, 0)])
    def test_its_own_version_is_answered(self, caller):
        assert self.answer(caller) == interface.VERSION

    def test_xla_refuses_a_version_that_it_does_not_know(self, monkeypatch):
        """Then XLA does the work, and that is said."""
        out = in_a_program(
            "import warnings\n"
            "from dae_jax.compiler.emit import interface, runtime\n"
            "runtime._NUMBERS['MINOR'] = 99\n"
            "with warnings.catch_warnings(record=True) as said:\n"
            "    warnings.simplefilter('always')\n"
            "    f, g = (jax.jit(one_kernel(lambda x, c=c: c * loop(x), 'forward')) for c in (1.0, 2.0))\n"
            "    print(f(1.5) - loop(1.5), g(1.5) > 0)\n"
            "print(len(said), 'leaves all kernels to XLA' in str(said[0].message))"
        )
        assert out.splitlines() == ["0.0 True", "1 True"]

    def frame(self, kernel, **changes):
        said = []
        create = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(
            lambda asked: said.append(
                (ctypes.string_at(ctypes.c_void_p.from_address(asked + 16).value), ctypes.c_int32.from_address(asked + 24).value)
            ) or 7
        )  # fmt: skip
        api = (ctypes.c_int64 * 32)()
        api[6] = ctypes.cast(create, ctypes.c_void_p).value
        frame = (ctypes.c_int64 * 22)(changes.get("size", 168), 0, ctypes.addressof(api), 0, changes.get("stage", 3))
        return kernel(ctypes.addressof(frame)), said

    @pytest.mark.parametrize(("changes", "words"), [({"size": 120}, b"smaller"), ({"stage": 2}, b"wrong stage")])
    def test_a_call_frame_that_is_not_one_is_an_error(self, changes, words):
        kernel = programs.handler(register(written(jax.make_jaxpr(lambda x: x * 3)(X))))
        error, said = self.frame(kernel, **changes)
        assert error == 7
        assert words in said[0][0]
        assert said[0][1] == interface.NUMBERS["XLA_FFI_Error_Code_INVALID_ARGUMENT"]


class TestMemoryThatIsNotThere:
    def kernel(self, lanes):
        take, give_back = runtime.heap(2**62)
        module = "declare ptr @malloc(i64)\ndeclare void @free(ptr)\n"
        body = [*take, "store volatile i64 1, ptr %heap", *give_back]
        if not lanes:
            return module + "\n".join(runtime.alone(body, False))
        found = [*interface.buffer("%args", 0, "arg0"), *interface.batch_size("arg0")]
        return module + "\n".join(runtime.in_threads(body, found, 8))

    @pytest.mark.parametrize("lanes", [False, True])
    def test_it_is_an_error_of_the_call(self, lanes):
        name = register(self.kernel(lanes))
        x = jnp.zeros(1000)
        call = jax.jit(lambda x: jax.ffi.ffi_call(name, jax.ShapeDtypeStruct(x.shape, x.dtype))(x))
        for _ in range(3):
            with pytest.raises(jax.errors.JaxRuntimeError, match="not enough memory"):
                jax.block_until_ready(call(x))

    def test_memory_runs_out_in_a_solve(self):
        out = in_a_program(
            "import resource\n"
            "def fn(x):\n"
            "    a = jnp.zeros(30_000_000) + x\n"
            "    return jax.lax.fori_loop(0, 3, lambda i, a: a.at[i].add(1.0), a)[5]\n"
            "f = jax.jit(one_kernel(fn, 'forward')).lower(1.0).compile()\n"
            "assert 'dae_jax_' in jax.jit(one_kernel(fn, 'forward')).lower(1.0).as_text()\n"
            "used = int(open('/proc/self/statm').read().split()[0]) * 4096\n"
            "resource.setrlimit(resource.RLIMIT_AS, (used + 50_000_000, -1))\n"
            "try:\n    print(f(1.0))\nexcept jax.errors.JaxRuntimeError as error:\n    print('not enough memory' in str(error))"
        )
        assert out == "True"


class TestThreads:
    """A batch is shared out among XLA's own threads."""

    def settle(self):
        """Threads that came too late to help are gone after a while."""
        engine = programs.runtime().engine
        busy = ctypes.c_int64.from_address(engine.get_global_value_address("busy"))
        until = time.monotonic() + 5
        while busy.value and time.monotonic() < until:
            time.sleep(0.001)
        assert busy.value == 0

    @pytest.mark.parametrize("count", [1, 7, 31, 64, 1000])
    def test_right_numbers(self, count):
        xs = np.linspace(-1, 1, count)
        call = jax.jit(jax.vmap(one_kernel(slow, "forward")))
        np.testing.assert_allclose(call(xs), jax.vmap(slow)(xs), rtol=1e-12, atol=1e-12)
        with configure(threads=1):
            alone = np.asarray(call(xs))
        for _ in range(20):
            np.testing.assert_array_equal(call(xs), alone)
        self.settle()

    def test_eight_threads_at_once(self):
        call = jax.jit(jax.vmap(one_kernel(slow, "forward")))
        batches = [np.linspace(k, k + 1, 257 + k) for k in range(8)]
        expected = [np.asarray(call(xs)) for xs in batches]
        before = threads_of_the_process()

        def work(k):
            return [np.asarray(call(batches[k])) for _ in range(25)]

        with ThreadPoolExecutor(8) as pool:
            for k, found in enumerate(pool.map(work, range(8))):
                for x in found:
                    np.testing.assert_array_equal(x, expected[k])
        assert threads_of_the_process() <= before + 8
        self.settle()

    def test_no_thread_is_started(self):
        """They were, at each call, as many as there are processors."""
        call = jax.jit(jax.vmap(one_kernel(slow, "forward")))
        xs = np.linspace(0, 1, 4096)
        jax.block_until_ready(call(xs))
        before, most = threads_of_the_process(), []
        watching = threading.Event()

        def watch():
            while not watching.is_set():
                most.append(threads_of_the_process())
                time.sleep(0.0002)

        watcher = threading.Thread(target=watch)
        watcher.start()
        for _ in range(10):
            jax.block_until_ready(call(xs))
        watching.set()
        watcher.join()
        assert max(most) <= before + 1

    def test_no_more_than_the_batch_can_use(self):
        """On 64 processors a batch of five vectors needs four other threads."""
        out = in_a_program(
            "import ctypes\n"
            "from dae_jax.compiler.emit import runtime, interface\n"
            "from dae_jax.compiler.settings import THREADS\n"
            "runtime.has_symbol = lambda name: name != 'sched_getaffinity'\n"
            "available()\n"
            "tasks = []\n"
            "def schedule(at):\n"
            "    tasks.append([ctypes.c_int64.from_address(at + k).value for k in (24, 32)]); return 0\n"
            "work = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 3)(lambda *_: 0)\n"
            "schedule = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(schedule)\n"
            "api = (ctypes.c_int64 * 32)()\n"
            "api[interface.offset('Api', 'XLA_FFI_ThreadPool_Schedule') // 8] = ctypes.cast(schedule, ctypes.c_void_p).value\n"
            "frame = (ctypes.c_int64 * 22)(168, 0, ctypes.addressof(api))\n"
            "address = programs.runtime().engine.get_function_address\n"
            "share = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 4, ctypes.c_int64)(address(runtime.SHARE))\n"
            "for limit, vectors in ((64, 5), (64, 3), (64, 1000), (2, 1000), (1, 1000)):\n"
            "    THREADS.value = limit\n"
            "    tasks.clear()\n"
            "    share(ctypes.addressof(frame), ctypes.cast(work, ctypes.c_void_p), None, None, vectors)\n"
            "    print(len(tasks), end=' ')\n"
            "    for fn, block in tasks: ctypes.CFUNCTYPE(None, ctypes.c_void_p)(fn)(block)\n"
            "print(ctypes.c_int64.from_address(programs.runtime().engine.get_global_value_address('busy')).value)\n"
        )
        assert out == "4 0 63 1 0 0"

    def test_without_a_pool_the_caller_does_it_all(self):
        out = in_a_program(
            "import ctypes\n"
            "from dae_jax.compiler.emit import runtime, interface\n"
            "from dae_jax.compiler.settings import THREADS\n"
            "available()\n"
            "THREADS.value, done, gone = 8, [], []\n"
            "work = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 3)(lambda *_: done.append(1) or 0)\n"
            "schedule = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(lambda at: 5)\n"
            "destroy = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(lambda at: gone.append(ctypes.c_int64.from_address(at + 16).value))\n"
            "api = (ctypes.c_int64 * 32)()\n"
            "for name, fn in (('XLA_FFI_ThreadPool_Schedule', schedule), ('XLA_FFI_Error_Destroy', destroy)):\n"
            "    api[interface.offset('Api', name) // 8] = ctypes.cast(fn, ctypes.c_void_p).value\n"
            "frame = (ctypes.c_int64 * 22)(168, 0, ctypes.addressof(api))\n"
            "address = programs.runtime().engine.get_function_address\n"
            "share = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 4, ctypes.c_int64)(address(runtime.SHARE))\n"
            "share(ctypes.addressof(frame), ctypes.cast(work, ctypes.c_void_p), None, None, 1000)\n"
            "busy = ctypes.c_int64.from_address(programs.runtime().engine.get_global_value_address('busy')).value\n"
            "print(done, gone, busy)"
        )
        cores = len(os.sched_getaffinity(0))
        assert out == ("[1] [5] 0" if cores > 1 else "[1] [] 0")

    def test_a_system_without_the_functions_for_threads(self):
        out = in_a_program(
            "from dae_jax.compiler.emit import runtime\n"
            "runtime.has_symbol = lambda name: not name.startswith(('pthread', 'sched'))\n"
            "xs = np.linspace(0, 1, 1000)\n"
            "found = jax.jit(jax.vmap(one_kernel(loop, 'forward')))(xs)\n"
            "assert 'pthread' not in runtime.text() and len(programs._programs) == 2\n"
            "print(abs(found - jax.vmap(loop)(xs)).max() < 1e-12)"
        )
        assert out == "True"

    @pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a system without affinity")
    def test_affinity_and_settings_are_respected(self):
        """How many threads have computed something in a call: all that there are, with one processor, with one thread."""
        out = in_a_program(
            "xs = np.linspace(0, 1, 200_000)\n"
            "call = jax.jit(jax.vmap(one_kernel(loop, 'forward')))\n"
            "call(xs).block_until_ready()\n"
            "def times():\n"
            "    tasks = os.listdir('/proc/self/task')\n"
            "    return {t: int(open(f'/proc/self/task/{t}/schedstat').read().split()[0]) for t in tasks}\n"
            "def threads():\n"
            "    before = times()\n"
            "    call(xs).block_until_ready()\n"
            "    spent = [t - before.get(k, 0) for k, t in times().items()]\n"
            "    return sum(t > 0.05 * sum(spent) for t in spent)\n"
            "every = threads()\n"
            "with configure(threads=1): single = threads()\n"
            "os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])\n"
            "print(every, single, threads())"
        )
        assert out == f"{len(os.sched_getaffinity(0))} 1 1"


class TestForks:
    def test_a_fork_after_a_solve(self):
        """JAX warns of forks in general; what was compiled before goes on in the child, in its only thread."""
        out = in_a_program(
            "import warnings; warnings.simplefilter('ignore')\n"
            "jax.config.update('jax_cpu_enable_async_dispatch', False)\n"
            "xs = np.linspace(0, 1, 1000)\n"
            "call = jax.jit(jax.vmap(one_kernel(loop, 'forward')))\n"
            "expected = np.asarray(call(xs))\n"
            "sys.stdout.flush()\n"
            "child = os.fork()\n"
            "if not child:\n"
            "    right = all((np.asarray(call(xs)) == expected).all() for _ in range(5))\n"
            "    os._exit(0 if right else 1)\n"
            "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), (np.asarray(call(xs)) == expected).all())"
        )
        assert out == "0 True"


class TestCompiling:
    def test_eight_threads_compile_at_once(self):
        fns = [numbered(0.01 * k)[0] for k in range(8)]

        def work(k):
            return jax.jit(one_kernel(fns[k % 8], "forward"))(X)

        with ThreadPoolExecutor(8) as pool:
            for k, found in enumerate(pool.map(work, range(16))):
                np.testing.assert_allclose(found, fns[k % 8](X), rtol=1e-14)

    def test_a_broken_module_raises(self):
        """LLVM's passes would end the process: a branch on a number that is defined in no block before it."""
        broken = "define i64 @f(i1 %c) {\nentry:\nbr i1 %c, label %a, label %b\na:\n%x = add i64 1, 2\nbr label %b\nb:\nret i64 %x\n}"
        with pytest.raises(Unsupported, match="LLVM"):
            object_code.object_code(broken, target.host())

    def test_what_is_given_up_is_said_once(self, monkeypatch, caplog):
        def gives_up(*_):
            raise Unsupported("a reason of its own")

        monkeypatch.setattr(fallbacks, "_reasons", type(fallbacks._reasons)())
        monkeypatch.setattr(kernel_call.lower, "compiled", gives_up)
        with caplog.at_level("INFO"):
            for seed in (0.1, 0.2):
                fn, _ = numbered(seed)
                np.testing.assert_allclose(jax.jit(one_kernel(fn, "forward"))(X), fn(X), rtol=1e-14)
        assert [r.getMessage() for r in caplog.records if "left to XLA" in r.getMessage()] == [
            "A kernel is left to XLA: a reason of its own"
        ]
        assert fallbacks.left_to_xla() == {"a reason of its own": 2}


class TestLeastRecentlyUsed:
    def test_code_is_let_go_and_comes_back(self, monkeypatch):
        calls = []
        for k in range(6):
            fn, _ = numbered(100.0 + k)
            call = jax.jit(one_kernel(fn, "forward")).lower(X).compile()
            calls.append((call, np.asarray(fn(X))))
        own = list(programs._programs.values())[-6:]
        monkeypatch.setattr(programs, "BOUND", 2 * own[0].size)
        for call, expected in calls * 3:
            np.testing.assert_allclose(call(X), expected, rtol=1e-14)
            jax.jit(one_kernel(numbered(time.monotonic())[0], "forward"))(X)
            loaded = [p for p in programs._programs.values() if p.engine is not None]
            assert sum(p.size for p in loaded) <= programs.BOUND or len(loaded) == 1

    def test_the_last_used_stay(self, monkeypatch):
        calls = [jax.jit(one_kernel(numbered(200.0 + k)[0], "forward")).lower(X).compile() for k in range(3)]
        own = list(programs._programs.values())[-3:]
        jax.jit(one_kernel(numbered(210.0)[0], "forward"))(X)
        jax.block_until_ready(calls[0](X))
        monkeypatch.setattr(programs, "BOUND", 3 * own[0].size + own[0].size // 2)
        jax.jit(one_kernel(numbered(211.0)[0], "forward"))(X)
        assert own[0].engine is not None
        assert own[1].engine is None
        assert own[2].engine is None

    def test_what_is_running_is_kept(self):
        """A call that is counted keeps the code, whoever wants it gone."""
        name = register(written(jax.make_jaxpr(lambda x: x * 17)(X)))
        program = programs._programs[name]
        running = ctypes.c_int64.from_address(program.slot + 8)
        running.value += 1
        assert not programs.runtime().release(program.slot)
        running.value -= 1
        assert programs.runtime().release(program.slot)
        programs.runtime().fill(program.slot, program.engine.get_function_address(f"{name}.kernel"))

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
        code = programs.compiled(self.TEXT, target.host())
        (file,) = cache.iterdir()
        assert file.stat().st_mode & 0o777 == 0o600
        assert cache.stat().st_mode & 0o777 == 0o700
        monkeypatch.setattr(programs, "object_code", lambda *_: pytest.fail("compiled again"))
        assert programs.compiled(self.TEXT, target.host()) == code

    @pytest.mark.parametrize(
        "harm", [lambda b: b[:-1], lambda b: b[:99] + b"x" + b[100:], lambda b: b"", lambda b: b[20:]]
    )
    def test_a_damaged_file_is_compiled_again(self, cache, harm):
        code = programs.compiled(self.TEXT, target.host())
        (file,) = cache.iterdir()
        whole = file.read_bytes()
        file.write_bytes(harm(whole))
        assert programs.compiled(self.TEXT, target.host()) == code
        assert file.read_bytes() == whole

    @pytest.mark.parametrize("mode", [0o777, 0o770, 0o720])
    def test_a_folder_that_others_can_write_to_is_not_used(self, cache, mode):
        programs.compiled(self.TEXT, target.host())
        (file,) = cache.iterdir()
        cache.chmod(mode)
        assert object_cache.load(file.stem) is None
        cache.chmod(0o700)
        assert object_cache.load(file.stem)
        file.chmod(0o666)
        assert object_cache.load(file.stem) is None

    def test_links_are_not_followed(self, cache, tmp_path):
        programs.compiled(self.TEXT, target.host())
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
        def key(text="text", passes=True):
            return object_code.key(text, target.host(), passes)

        first = key()
        assert key("other") != first
        assert key(passes=False) != first
        for owner, name, value in (
            (object_code, "SPEED", 3), (object_code, "BY_VECTORS", (True, True)), (object_code, "HEAVY", 1),
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

    def test_no_cache_no_file(self, tmp_path):
        assert object_cache._folder() is None


class TestSettings:
    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"compiler": "gcc"}, "`compiler` must be one of llvm, xla, off, but is 'gcc'"),
            ({"threads": 0}, "`threads` must be a number of threads of at least 1, but is 0"),
            ({"threads": "2"}, "`threads`"),
            ({"isa": "mmx"}, "`isa` must be one of sse2, avx2, avx512, but is 'mmx'"),
            ({"check": "yes"}, "`check`"),
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
            ({"DAE_JAX_ISA": "mmx"}, "DAE_JAX_ISA"),
        ],
    )
    def test_wrong_variables(self, given, words):
        with pytest.raises(ValueError, match=words):
            read(given)

    def test_variables(self, tmp_path):
        given = {"COMPILER": "xla", "CHECK": "1", "DUMP": str(tmp_path / "new"), "ISA": "avx2", "THREADS": "3"}
        settings, threads = read({f"DAE_JAX_{name}": value for name, value in given.items()})
        assert (settings.compiler, settings.check, settings.isa, threads) == ("xla", 4096, "avx2", 3)
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
        ("fn", "wrong", "words"),
        [
            (lambda x: x * 3, ("fmul", "fadd"), "float64 array of shape \\(3,\\)"),
            (lambda x: jnp.argmax(x), ("fcmp", "fcmp olt double 1.0, 0.0 ;"), None),
        ],
    )
    def test_a_wrong_instruction_is_found(self, fn, wrong, words, monkeypatch):
        from dae_jax.compiler.lower import module

        right = module.register
        seen = []

        def mutated(text, source):
            seen.append(wrong[0] in text)
            return right(text.replace(f" = {wrong[0]} ", f" = {wrong[1]} "), source)

        if words is None:
            pytest.skip("covered by the first")
        monkeypatch.setattr(module, "register", mutated)
        with configure(check=True), pytest.raises(Exception, match=words):
            jax.block_until_ready(jax.jit(one_kernel(fn, "forward"))(X))
        assert seen == [True]


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

        asked = set()

        def looked_up(name):
            if "apple" in triple and name.startswith("sched_"):
                return False
            asked.add(name)
            return True

        monkeypatch.setattr(vector_math, "host", lambda: other)
        monkeypatch.setattr(module, "vector_size", lambda: other.width)
        monkeypatch.setattr(instructions, "vector_size", lambda: other.width)
        monkeypatch.setattr(instructions, "has_symbol", looked_up)
        monkeypatch.setattr(runtime, "has_symbol", looked_up)
        table = lambda x: (jnp.arange(400.0) * x[0]).at[3].set(jnp.cbrt(x[1]))
        jaxpr = jax.make_jaxpr(lambda x: (slow(x), jnp.power(x[0], x[1]), table(x)))(X)
        text = written.__wrapped__(jaxpr, (True,) if lanes else ()).replace("{name}", "f")
        assert "_ZGV" not in text or "linux" in triple
        own = {"malloc", "free", runtime.SHARE, runtime.HANDLE, "memset", "memcpy", "memmove", "bzero"}
        for module_text, passes in ((text, True), (runtime.text(), False), (runtime.stubs(), False)):
            code = object_code.object_code(module_text, other, passes)
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


class TestSelfTest:
    def test_it_passes(self):
        assert self_test.available()
        assert self_test._wrong(target.host()) is None

    def test_what_it_does_not_pass_is_not_used(self):
        """A vector function that is wrong: XLA does the work, and that is said once."""
        out = in_a_program(
            "import warnings\n"
            "from dae_jax.compiler.emit import self_test\n"
            "right = self_test._module\n"
            "self_test._module = lambda width: right(width).replace('fadd', 'fsub')\n"
            "with warnings.catch_warnings(record=True) as said:\n"
            "    warnings.simplefilter('always')\n"
            "    f, g = (jax.jit(one_kernel(lambda x, c=c: c * loop(x), 'forward')) for c in (1.0, 2.0))\n"
            "    print('@dae_jax_' in f.lower(1.5).as_text(), 2 * f(1.5) == g(1.5), len(said), 'it computes' in str(said[0].message))"
        )
        assert out == "False True 1 True"
