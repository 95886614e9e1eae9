"""A batch in XLA's own threads, calls from many threads, forks, and compiling in many threads."""

import ctypes
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from dae_jax.compiler import _compat, fallbacks, kernel_call, one_kernel
from dae_jax.compiler.emit import object_code, programs, target
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import written
from dae_jax.compiler.settings import configure
from tests.compiler.samples import X, in_a_program, numbered, slow


def threads_of_the_process():
    return len(os.listdir("/proc/self/task"))


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
        """On 64 processors a batch of five vectors needs four other threads; where all are busy none is asked for."""
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
            "THREADS.value, depth = 4, []\n"
            "def inside(*_):\n"
            "    depth.append(len(tasks))\n"
            "    return share(ctypes.addressof(frame), ctypes.cast(nested, ctypes.c_void_p), None, None, 1000) if len(depth) < 3 else 0\n"
            "nested = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 3)(inside)\n"
            "tasks.clear()\n"
            "share(ctypes.addressof(frame), ctypes.cast(nested, ctypes.c_void_p), None, None, 1000)\n"
            "print(*depth, end=' ')\n"
            "for fn, block in tasks: ctypes.CFUNCTYPE(None, ctypes.c_void_p)(fn)(block)\n"
            "print(ctypes.c_int64.from_address(programs.runtime().engine.get_global_value_address('busy')).value)\n"
        )
        assert out == "4 0 63 1 0 3 3 3 0"

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
            # On a machine that is busy a thread may find nothing left to do.
            "every = max(threads() for _ in range(20))\n"
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

    def test_a_fork_while_code_is_made(self):
        """The child has no thread that would go on with it, and makes its own later."""
        out = in_a_program(
            "import warnings; warnings.simplefilter('ignore')\n"
            "jax.config.update('jax_cpu_enable_async_dispatch', False)\n"
            "from dae_jax.compiler.emit.target import host\n"
            "available()\n"
            "expected = float(jax.jit(loop)(1.5))\n"
            "made = programs.object_code\n"
            "programs.object_code = lambda module: __import__('time').sleep(0.5) or made(module)\n"
            "begun = jax.jit(one_kernel(loop, 'forward')).lower(1.5).compile()\n"
            "child = os.fork()\n"
            "if not child:\n"
            "    right = float(begun(1.5)) == expected and programs.compiled('define i64 @f() {\\nret i64 8\\n}', host()).result()\n"
            "    os._exit(0 if right else 1)\n"
            "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), begun(1.5) == expected)"
        )
        assert out == "0 True"


class TestCompiling:
    def test_llvm_works_while_another_thread_is_in_it(self, monkeypatch):
        """The two steps that take long do without llvmlite's lock."""
        lock, free = target.llvm().ffi.lib._lock, []

        def watched(function):
            """The function, called while another thread has the lock."""

            def call(*args):
                taken, returned = threading.Event(), threading.Event()

                def hold():
                    with lock:
                        taken.set()
                        free.append(returned.wait(20))

                other = threading.Thread(target=hold)
                other.start()
                taken.wait()
                result = _compat.without_lock(function)(*args)
                returned.set()
                other.join()
                return result

            return call

        monkeypatch.setattr(object_code, "without_lock", watched)
        assert object_code.object_code(object_code.verified("define i64 @f() {\nret i64 7\n}", target.host()))
        assert free == [True, True]

    def test_modules_become_code_in_many_threads(self):
        """The same code as one after another."""
        texts = [written(jax.make_jaxpr(numbered(500.0 + k)[0])(X)).replace("{name}", f"f{k}") for k in range(8)]
        code = lambda text: object_code.object_code(object_code.verified(text, target.host()))
        expected = list(map(code, texts))
        with ThreadPoolExecutor(8) as pool:
            assert list(pool.map(code, texts * 4)) == expected * 4

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
            object_code.verified(broken, target.host())

    def test_what_is_given_up_is_said_once(self, monkeypatch, caplog):
        def gives_up(*_, **__):
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
