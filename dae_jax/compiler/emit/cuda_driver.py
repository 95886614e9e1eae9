"""NVIDIA's driver, by its own library: kernels loaded from PTX, and launched on XLA's streams. No CUDA toolkit is needed."""

import ctypes
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

from ..jaxprs.scalar_interpreter import Unsupported
from ..thresholds import THRESHOLDS


# cuda.h
_MULTIPROCESSORS = 16
# Threads of a block: a warp while there are fewer elements than that gives every multiprocessor several.
WARP, BLOCK, WARPS_EACH = 32, 64, 4


@dataclasses.dataclass(frozen=True)
class Function:
    """A kernel on one device: `threads`, how many of it run at a time; `memory`, the bytes that the device has."""

    handle: int
    multiprocessors: int
    threads: int
    memory: int

    def grid(self, elements: int, threads: int) -> tuple[int, int]:
        """How many blocks there are for so many elements, by at most so many threads, and how many threads in each."""
        small = min(elements, threads) <= WARP * WARPS_EACH * self.multiprocessors
        block = WARP if small or threads % BLOCK else BLOCK
        return min(-(-elements // block), max(threads // block, 1)), block


class Driver:
    """The driver's library."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL("libcuda.so.1")
        self._call("cuInit", 0)

    def _call(self, name: str, *args: Any) -> None:
        status = getattr(self._library, name)(*args)
        if status:
            said = ctypes.c_char_p()
            self._library.cuGetErrorName(status, ctypes.byref(said))
            raise RuntimeError(f"{name}: {(said.value or b'error').decode()} ({status})")

    def _number(self, name: str, *args: Any) -> int:
        found = ctypes.c_int()
        self._call(name, ctypes.byref(found), *args)
        return found.value

    def load(self, code: str, name: str, device: int) -> tuple[int, Function]:
        """A kernel in the context of a device that XLA uses too; gives the context.

        Errors: `Unsupported` with what the driver's compiler says.
        """
        context, module, function = (ctypes.c_void_p() for _ in range(3))
        handle, memory = ctypes.c_int(), ctypes.c_size_t()
        self._call("cuDeviceGet", ctypes.byref(handle), device)
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(context), handle)
        self._call("cuCtxPushCurrent_v2", context)
        try:
            # 5, 6: where the compiler writes what is wrong, and how long that may be; 7: how much it optimises.
            said = ctypes.create_string_buffer(4096)
            options = (ctypes.c_int * 3)(5, 6, 7)
            values = (ctypes.c_void_p * 3)(ctypes.addressof(said), len(said), effort(code))
            try:
                self._call("cuModuleLoadDataEx", ctypes.byref(module), code.encode(), len(options), options, values)
            except RuntimeError as error:
                raise Unsupported(f"{error}: {said.value.decode(errors='replace')[:500]}") from error
            self._call("cuModuleGetFunction", ctypes.byref(function), module, name.encode())
            blocks = self._number("cuOccupancyMaxActiveBlocksPerMultiprocessor", function, BLOCK, ctypes.c_size_t(0))
            count = self._number("cuDeviceGetAttribute", _MULTIPROCESSORS, handle)
            self._call("cuDeviceTotalMem_v2", ctypes.byref(memory), handle)
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))
        assert context.value is not None
        assert function.value is not None
        return context.value, Function(function.value, count, blocks * count * BLOCK, memory.value)

    def context_of(self, stream: int) -> int:
        """The context that a stream belongs to."""
        context = ctypes.c_void_p()
        self._call("cuStreamGetCtx", ctypes.c_void_p(stream), ctypes.byref(context))
        assert context.value is not None
        return context.value

    def launch(self, function: Function, elements: int, threads: int, stream: int, pointers: Sequence[int]) -> None:
        """Runs a kernel of these pointers and the number of elements, by at most so many threads."""
        grid, block = function.grid(elements, threads)
        values = [ctypes.c_uint64(p) for p in (*pointers, elements)]
        parameters = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
        self._call(
            "cuLaunchKernel",
            ctypes.c_void_p(function.handle),
            *(grid, 1, 1, block, 1, 1, 0),
            ctypes.c_void_p(stream),
            parameters,
            None,
        )


def effort(code: str) -> int:
    """How much the driver's compiler optimises a kernel, of 4 at most."""
    return 1 if code.count("\n") > THRESHOLDS.ptx_lines else 4


@functools.cache
def driver() -> Driver:
    """The driver of this machine. Errors: `OSError` where there is none, `RuntimeError` where it does not work."""
    return Driver()
