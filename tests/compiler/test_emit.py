"""XLA's interface is the one of the header that comes with JAX; what is no call of it, or finds no memory, is an error."""

import ctypes
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from dae_jax.compiler.emit import interface, programs, register, runtime, self_test, target
from dae_jax.compiler.lower.module import written
from tests.compiler.samples import X, in_a_program


@pytest.fixture(scope="module")
def header():
    text = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()
    # As it is called from JAX 0.12 on.
    text = re.sub(r"//.*", "", text).replace("XLA_FFI_InternalExtension", "XLA_FFI_Extension_Base")
    return re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\);", r"void* \1;", text)


def found_in(text, pattern):
    found = re.search(pattern, text, re.DOTALL)
    assert found, pattern
    return found[1]


class TestInterface:
    """The offsets are those of the header that comes with JAX."""

    SIZES = {"size_t": 8, "int64_t": 8, "int64_t*": 8, "int": 4, "uint32_t": 4}  # noqa: RUF012

    def layout(self, header, name):
        """Offset of each field, alignment, and size."""
        body = found_in(header, rf"struct {name} {{(.*?)}}")
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
            kind = found_in(header, rf"struct {name} {{.*?([\w*]+)\s+{field};")
            assert interface.OFFSETS[name][""] == found[field] + self.size(header, kind)[0]

    def test_numbers(self, header):
        for name, number in interface.NUMBERS.items():
            assert int(found_in(header, rf"{name} = (\d+)")) == number

    def test_version(self, header):
        """Where this fails, look at what changed in the header before changing `VERSION`."""
        found = tuple(int(found_in(header, rf"XLA_FFI_API_{part} (\d+)")) for part in ("MAJOR", "MINOR"))
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
