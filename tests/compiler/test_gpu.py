"""Kernels for GPUs without a GPU: the program of a thread is run here, PTX is taken by NVIDIA's assembler, launches are looked at."""

import ctypes
import dataclasses
import os
import shutil
import subprocess
import types
import warnings
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dae_jax
from dae_jax.compiler import kernel_call, lower, on_gpu
from dae_jax.compiler.emit import cuda_driver, interface, launch, ptx, register, target
from dae_jax.compiler.jaxprs.scalar_interpreter import Unsupported
from dae_jax.compiler.lower import arithmetic, extrema
from dae_jax.compiler.lower.registry import RULES
from dae_jax.compiler.thresholds import THRESHOLDS
from dae_jax.scenes import pendulum
from tests.compiler.fuzz import campaign, check
from tests.methods import METHODS


PARTS = 4
HERE = dataclasses.replace(target.host(), width=1, threads=True)
FOLDERS = list(ptx._folders())
PTXAS = next((str(f) for folder in FOLDERS for f in folder.glob("bin/ptxas")), shutil.which("ptxas"))
HAS_CUDA = PTXAS is not None and ptx.libdevice() is not None
NEEDS_CUDA = pytest.mark.skipif(
    not HAS_CUDA,
    reason="NVIDIA's assembler and libdevice are in the package nvidia-cuda-nvcc",
)


def on_threads(jaxpr, lanes):
    """A batch as threads of a GPU compute it, but here."""
    name = register(lower.written(jaxpr, lanes, target=HERE))
    first = lanes.index(True)

    def call(*xs):
        structs = [jax.ShapeDtypeStruct((xs[first].shape[0], *v.aval.shape), v.aval.dtype) for v in jaxpr.jaxpr.outvars]
        return jax.ffi.ffi_call(name, structs)(*xs)

    return jax.jit(call)


def solve(method, t1=0.3):
    scene = pendulum()
    adaptive = {"stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)} if method.adaptive else {}
    options = {"formulation": method.formulation} if method.formulation else {}

    def ys(q, v):
        dt0 = None if method.adaptive else 0.01
        sol = dae_jax.daesolve(
            scene.system, method.solver, 0.0, t1, dt0, (q, v), max_steps=100, throw=False, **adaptive, **options
        )
        return sol.ys

    return ys


def starts(count=5):
    angle = np.linspace(-1.0, 1.0, count)
    return np.stack([np.sin(angle), np.cos(angle)], 1), np.stack([np.cos(angle), -np.sin(angle)], 1) * angle[:, None]


def derived(method, gradient):
    loss = lambda q, v: jnp.sum(solve(method)(q, v)[0] * jnp.array([1.0, 2.0]))
    return jax.grad(loss, argnums=(0, 1)) if gradient else solve(method)


def assembled(jaxpr, lanes, folder):
    """What NVIDIA's assembler says of a kernel's registers, for each of two generations of GPUs."""
    said = []
    for capability in (80, 90):
        to, file = ptx.target(capability), folder / "k.ptx"
        file.write_text(ptx.ptx(lower.written(jaxpr, lanes, target=to).replace("{name}", "k"), to))
        command = [PTXAS, "-v", f"-arch={to.cpu}", file, "-o", folder / "k.cubin"]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        said += [line.partition(":")[2].strip() for line in ran.stderr.splitlines() if "Used" in line][-1:]
    return said


OWN = [method for method in METHODS if not method.twin]


@pytest.mark.parametrize("gradient", [False, True], ids=["solve", "gradient"])
@pytest.mark.parametrize("method", OWN, ids=lambda m: m.name)
def test_a_method_as_threads(method, gradient, monkeypatch, tmp_path, capsys):
    """Every method, its solve and its gradient: threads give what the lanes of vectors give, and NVIDIA's assembler takes their program.
    XLA's stays which change of the start a derivative takes, once, by LAPACK.
    """
    fn, seen, by_xla = derived(method, gradient), [], []

    def compiled(jaxpr, lanes, **_):
        if any(lanes) and {x.primitive for x in lower.unsupported(jaxpr, tuple(lanes), HERE)} == {"eigh"}:
            by_xla.append(jaxpr)
        if not any(lanes) or jaxpr in by_xla:
            return before(jaxpr, lanes)
        seen.append((jaxpr, tuple(lanes)))
        return on_threads(jaxpr, lanes)

    wanted, before = jax.jit(jax.vmap(fn))(*starts(7)), kernel_call.lower.compiled
    monkeypatch.setattr(kernel_call.lower, "compiled", compiled)
    found = jax.jit(jax.vmap(lambda q, v: fn(q, v)))(*starts(7))
    assert seen
    assert len(by_xla) <= gradient
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert np.isfinite(b).all()
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    for kernel in seen if HAS_CUDA else ():
        said = assembled(*kernel, tmp_path)
        with capsys.disabled():
            print(f"\n{method.name}, {'gradient' if gradient else 'solve'}: {'; '.join(said)}", end="")


@pytest.mark.parametrize("part", range(PARTS))
def test_programs_at_random(part, monkeypatch):
    """As XLA has them, but for calls of the host; and PTX comes of them: what LLVM has no instruction for would end the process."""

    def compiled(jaxpr, lanes, copies):
        if not lanes:
            return lower.compiled(jaxpr, lanes, copies)
        if ptx.libdevice() is not None:
            text = lower.written(jaxpr, lanes, copies, ptx.target(90)).replace("{name}", "k")
            assert ".visible .entry" in ptx.ptx(text, ptx.target(90))
        return on_threads(jaxpr, lanes)

    monkeypatch.setattr(check, "compiled", compiled)
    bundles = list(campaign.bundles(campaign.fixed()))[part::PARTS][:: int(os.environ.get("DAE_JAX_GPU_FUZZ", "4"))]
    lines = [line for bundle in bundles for line in campaign.report(bundle)]
    on_host = [f"`{name}` runs on the host" for name, rule in RULES.items() if rule.on_host]
    differing = [line for line in lines if not any(said in line for said in on_host)]
    assert not differing, "\n\n".join(differing)


def test_large_arrays_of_threads_lie_side_by_side():
    """3 threads, 8 elements each of which has its own table, larger than a thread has memory for."""

    def table(x, n):
        rows = jnp.zeros((2000, 2)).at[n].set(x)
        return (
            jax.lax.fori_loop(0, 2000, lambda i, c: (c[0].at[i].add(jnp.sin(c[1])), c[1] + 0.1), (rows, x))[0][::400]
            + n
        )

    jaxpr = jax.make_jaxpr(table)(jnp.ones(2), 1)
    text = lower.written(jaxpr, (True, True), target=HERE)
    assert "%room" in text
    xs = np.arange(16.0).reshape(8, 2), np.arange(0, 1600, 200)
    np.testing.assert_allclose(on_threads(jaxpr, (True, True))(*xs)[0], jax.vmap(table)(*xs), rtol=1e-13)


def test_maxima_of_doubles(monkeypatch):
    """A GPU has no maximum that passes NaN on: what stands for it gives what the vectors' does, to the sign of a zero."""

    def of_a_gpu(code, *args):
        before, code.target = code.target, ptx.target(90)
        found = extrema.extremum(code, *args)
        code.target = before
        return found

    numbers = np.array([np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 3e-308, -3e-308, 1e308, 2.5])
    x, y = (a.ravel() for a in np.meshgrid(numbers, numbers))

    def fn(x, y):
        of_both = [f(a, b) for f in (jnp.maximum, jnp.minimum) for a, b in ((x, y), (abs(x), abs(y)), (abs(x), y))]
        known = [f(x, c) for f in (jnp.maximum, jnp.minimum) for c in (0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan)]
        of_maxima = [jnp.maximum(jnp.maximum(abs(x), 0.0), abs(y)), jnp.maximum(jnp.maximum(abs(x), 2.0), -y)]
        return jnp.stack([*of_both, *known, *of_maxima])

    jaxpr = jax.make_jaxpr(fn)(1.0, 1.0)
    wanted = np.asarray(lower.compiled(jaxpr, (True, True))(x, y)[0])
    monkeypatch.setattr(arithmetic, "extremum", of_a_gpu)
    text = lower.written(jaxpr, (True, True), target=HERE)
    assert "llvm.umax.i64" in text
    found = np.asarray(on_threads(jaxpr, (True, True))(x, y)[0])
    assert (np.isnan(found) == np.isnan(wanted)).all()
    # Of two unknown numbers that are 0 a GPU's own instruction has the sign right, and this machine's has not.
    left = np.isnan(wanted) | ((wanted == 0) & np.isin(np.arange(wanted.shape[1]), (0, 2, 3, 5)))
    assert (found.view(np.int64)[~left] == wanted.view(np.int64)[~left]).all()


class Driver:
    """A driver that writes down what it is asked for."""

    def __init__(self, refuses=False):
        self.launched, self.refuses = [], refuses

    def load(self, code, name, device):
        if self.refuses:
            raise Unsupported("the driver's compiler")
        assert f".entry {name}(" in code
        return 7, cuda_driver.Function(1, 4, 4096, 2**30)

    def context_of(self, stream):
        return 7

    def launch(self, function, elements, threads, stream, pointers):
        self.launched.append((function.grid(elements, threads), stream, pointers))


@pytest.fixture
def driver(monkeypatch):
    made = Driver()
    monkeypatch.setattr(launch, "driver", lambda: made)
    monkeypatch.setattr(
        jax, "local_devices", lambda **_: [types.SimpleNamespace(local_hardware_id=0, compute_capability="9.0")]
    )
    monkeypatch.setattr(on_gpu, "_test", lambda *_: None)
    on_gpu.gpu.cache_clear()
    yield made
    on_gpu.gpu.cache_clear()


def loop(x):
    return jax.lax.while_loop(lambda x: x[0] < 3, lambda x: x * 1.5, x)


@NEEDS_CUDA
class TestLaunch:
    def frame(self, sizes, batch, **changes):
        """A call frame as XLA makes it, and what was said of errors."""
        keep, said = [], []

        def words(*values):
            keep.append((ctypes.c_uint64 * len(values))(*values))
            return ctypes.addressof(keep[-1])

        def function(answer):
            keep.append(ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_uint64)(answer))
            return ctypes.cast(keep[-1], ctypes.c_void_p).value

        def stream(asked):
            ctypes.c_uint64.from_address(asked + 24).value = 55
            return 0

        def error(asked):
            said.append(ctypes.string_at(ctypes.c_uint64.from_address(asked + 16).value).decode())
            return 9

        api = words(*[0] * 6, function(error), 0, 0, 0, function(stream))
        buffers = [words(48, 0, 0, 100 + k, 1, words(batch)) for k in range(sum(sizes))]
        of = lambda part: (40, 0, len(part), 0, words(*part))
        args, results = of(buffers[: sizes[0]]), of(buffers[sizes[0] :])
        values = [
            changes.get("size", 168),
            changes.get("extension", 0),
            api,
            33,
            changes.get("stage", 3),
            *args,
            *results,
        ]
        return words(*values), keep, said

    def kernel(self):
        jaxpr = jax.make_jaxpr(loop)(jnp.ones(2))
        text = lower.written(jaxpr, (True,), target=ptx.target(90))
        return launch.kernel(launch.register(text, ptx.target(90), 0))

    def test_a_call(self, driver):
        frame, _keep, said = self.frame((1, 1), 1000)
        assert self.kernel().handler(frame) is None
        assert (driver.launched, said) == ([((16, 64), 55, [100, 101])], [])

    def test_no_element(self, driver):
        frame, _keep, _ = self.frame((1, 1), 0)
        assert self.kernel().handler(frame) is None
        assert driver.launched == []

    @pytest.mark.parametrize(("changes", "words"), [({"size": 120}, "smaller"), ({"stage": 2}, "wrong stage")])
    def test_what_is_no_call_is_an_error(self, driver, changes, words):
        frame, _keep, said = self.frame((1, 1), 5, **changes)
        assert self.kernel().handler(frame) == 9
        assert words in said[0]
        assert driver.launched == []

    def test_what_the_driver_says_is_an_error(self, driver, monkeypatch):
        def fails(*_):
            raise RuntimeError("cuLaunchKernel: CUDA_ERROR_OUT_OF_MEMORY (2)")

        monkeypatch.setattr(driver, "launch", fails)
        frame, _keep, said = self.frame((1, 1), 5)
        assert self.kernel().handler(frame) == 9
        assert said == ["dae_jax: cuLaunchKernel: CUDA_ERROR_OUT_OF_MEMORY (2)"]

    def test_the_version_of_the_interface(self, driver):
        metadata = (ctypes.c_uint64 * 6)(48)
        extension = (ctypes.c_uint64 * 4)(
            32, interface.NUMBERS["XLA_FFI_Extension_Metadata"], 0, ctypes.addressof(metadata)
        )
        frame, _keep, _ = self.frame((1, 1), 5, extension=ctypes.addressof(extension))
        assert self.kernel().handler(frame) is None
        assert tuple((ctypes.c_int32 * 2).from_address(ctypes.addressof(metadata) + 24)) == interface.VERSION
        assert driver.launched == []

    def test_the_program_calls_it(self, driver):
        text = self.lowered()
        assert "dae_jax_gpu_" in text
        assert "while" not in text

    def test_what_the_driver_does_not_take_is_left_to_xla(self, driver, monkeypatch):
        driver.refuses = True
        monkeypatch.setattr(launch, "_kernels", {})
        assert "while" in self.lowered()

    def test_what_is_said_of_it(self, driver, monkeypatch):
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        many = jax.make_jaxpr(lambda x: jnp.linalg.svd(x)[1])(jnp.ones((3, 3)))
        found = [kernel_call.decision(jaxpr).compiler for jaxpr in (jax.make_jaxpr(loop)(jnp.ones(2)), many)]
        assert found == ["llvm", "xla"]

    def lowered(self):
        fn = dae_jax.compiler.jit(loop)
        return jax.jit(jax.vmap(fn)).trace(np.ones((7, 2))).lower(lowering_platforms=("cuda",)).as_text()

    @pytest.mark.parametrize(
        ("elements", "threads", "grid"), [(1, 4096, (1, 32)), (10**6, 4096, (64, 64)), (10**6, 96, (3, 32))]
    )
    def test_grids(self, elements, threads, grid):
        assert cuda_driver.Function(1, 4, 4096, 2**30).grid(elements, threads) == grid

    def test_long_kernels_are_optimised_less(self):
        assert cuda_driver.effort("\n" * THRESHOLDS.ptx_lines) == 4
        assert cuda_driver.effort("\n" * (THRESHOLDS.ptx_lines + 1)) == 1

    def test_room_is_a_part_of_the_memory(self):
        function = cuda_driver.Function(1, 4, 4096, 2**30)
        assert launch.Kernel({7: function}, 0, 2**16).room_for(10**6) == 2**16 * 2048
        assert launch.Kernel({7: function}, 0, 2**16).room_for(10) == 2**16 * 32
        with pytest.raises(Unsupported, match="of each thread"):
            launch.Kernel({7: function}, 0, 2**23)


class TestTrust:
    def test_without_a_gpu(self, monkeypatch):
        assert on_gpu.gpu() is None
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        found = kernel_call.decision(jax.make_jaxpr(loop)(jnp.ones(2)))
        assert (found.compiler, found.unsupported[0].reason) == ("xla", "there is no GPU that kernels work on")

    def test_a_self_test_that_fails_leaves_all_to_xla(self, driver, monkeypatch):
        def differs(*_):
            raise AssertionError("0.1 where 0.2 is right")

        monkeypatch.setattr(on_gpu, "_test", differs)
        with pytest.warns(RuntimeWarning, match="leaves all kernels on GPUs to XLA.*0.1 where 0.2"):
            assert on_gpu.gpu() is None
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert on_gpu.gpu() is None
            text = jax.jit(jax.vmap(dae_jax.compiler.jit(loop))).trace(np.ones((7, 2)))
            assert "while" in text.lower(lowering_platforms=("cuda",)).as_text()

    def test_what_is_tested_is_sensitive_to_little(self):
        """Rounding moves what the self-test computes by less than it allows, so that it fails for what is wrong."""
        rng = np.random.default_rng(0)
        turns, x = rng.integers(0, 60, 200), rng.normal(size=(200, 2))
        exact, rounded = (jax.vmap(on_gpu._solve)(turns, x.astype(t)) for t in (float, np.float32))
        assert np.max(np.abs(exact - rounded)) < on_gpu.UNITS * np.finfo(np.float32).eps * np.max(exact)

    def test_old_gpus_are_refused(self):
        with pytest.raises(Unsupported, match=r"compute capability 6\.1"):
            ptx.target(61)
        assert ptx.target(120).cpu == "sm_90"

    @NEEDS_CUDA
    def test_a_broken_module_is_refused(self):
        with pytest.raises(Unsupported, match="LLVM"):
            ptx.ptx("define void @f() {\n ret i32 0\n}", ptx.target(90))
        assert isinstance(ptx.libdevice(), bytes)
        assert all(isinstance(folder, Path) for folder in FOLDERS)
