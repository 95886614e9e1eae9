"""Kernels for GPUs, as functions that XLA calls: the handler takes the buffers and the stream, and launches.

It is written in Python: that costs a call about 20 µs, which a solve on a GPU takes many times over.
"""

import ctypes
import hashlib
import threading
from collections.abc import Callable
from typing import Any

import jax

from ..jaxprs.scalar_interpreter import Unsupported
from . import object_cache
from .cuda_driver import WARP, Function, driver
from .interface import NUMBERS, VERSION, offset
from .object_code import key
from .ptx import bytes_of_room, ptx
from .target import Target


# The room that threads have is this part of a device's memory at most.
ROOM = 8

_lock = threading.Lock()
_handler_type = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
# The kernels and their handlers, which XLA keeps for the life of the process.
_kernels: dict[str, "Kernel"] = {}


class Kernel:
    """A kernel on each device that JAX has.

    - `first`: the argument whose leading axis is that of the batch.
    - `room`: bytes that each thread has of a buffer, which is the last result.

    Errors: `Unsupported` where a device has not enough memory for the room of a warp.
    """

    def __init__(self, functions: dict[int, Function], first: int | None, room: int) -> None:
        self.functions, self.first, self.room = functions, first, room
        self.handler = _handler_type(self._answer)
        self._threads = min(min(f.threads, f.memory // ROOM // max(room, 1)) for f in functions.values()) // WARP * WARP
        if not self._threads:
            raise Unsupported(f"its arrays take {room} bytes of each thread", primitive="size")

    def room_for(self, elements: int) -> int:
        """The bytes of the buffer that threads have room in, for so many elements."""
        return self.room * min(-(-max(elements, 1) // WARP) * WARP, self._threads)

    def _answer(self, frame: int) -> int | None:
        """What XLA gets of a call: the address of an error, or none."""
        try:
            if _word(frame) < offset("CallFrame"):
                raise ValueError("XLA's call frame is smaller than that of its interface")
            extension = _word(frame + offset("CallFrame", "extension_start"))
            if extension and _is_metadata(extension):
                _answer_version(_word(extension + offset("Metadata_Extension", "metadata")))
            else:
                self._launch(frame)
        except Exception as error:  # what is raised in here would be lost
            return _error(frame, f"dae_jax: {error}")
        return None

    def _launch(self, frame: int) -> None:
        stage = ctypes.c_int32.from_address(frame + offset("CallFrame", "stage")).value
        if stage != NUMBERS["XLA_FFI_ExecutionStage_EXECUTE"]:
            raise ValueError("a compiled function was called in a wrong stage")
        args, results = (_buffers(frame, field) for field in ("args", "rets"))
        elements = 1 if self.first is None else _word(_word(args[self.first] + offset("Buffer", "dims")))
        if not elements:
            return
        stream = _stream(frame)
        function = self.functions[driver().context_of(stream)]
        pointers = [_word(b + offset("Buffer", "data")) for b in (*args, *results)]
        threads = function.threads
        if self.room:
            threads = _word(_word(results[-1] + offset("Buffer", "dims"))) // self.room
        driver().launch(function, elements, threads, stream, pointers)


def register(module: str, target: Target, first: int | None) -> str:
    """Compiles a module with a kernel `{name}_kernel`, and gives the name by which XLA calls it.

    Errors: `Unsupported` for a module that is broken, or that the driver does not take.
    """
    name = "dae_jax_gpu_" + hashlib.sha256(f"{target} {first} {module}".encode()).hexdigest()[:32]
    with _lock:
        if name not in _kernels:
            # PTX has no dots in names; LLVM would write others.
            code = compiled(module.replace("{name}", name), target)
            devices = [d.local_hardware_id for d in jax.local_devices(backend="cuda")]
            functions = dict(driver().load(code, f"{name}_kernel", k or 0) for k in devices)
            _kernels[name] = Kernel(functions, first, bytes_of_room(module))
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_kernels[name].handler), platform="CUDA")
    return name


def compiled(text: str, target: Target) -> str:
    """PTX, from the cache on disk where that has it."""
    made_of = key(text, target, optimise=True)
    code = object_cache.load(made_of)
    if code is None:
        code = ptx(text, target).encode()
        object_cache.keep(made_of, code)
    return code.decode()


def kernel(name: str) -> Kernel:
    """A registered kernel."""
    return _kernels[name]


def _word(address: int) -> int:
    return ctypes.c_uint64.from_address(address).value


def _buffers(frame: int, field: str) -> list[int]:
    """The buffers of the arguments (`args`) or of the results (`rets`)."""
    at = frame + offset("CallFrame", field)
    count, first = _word(at + offset(field.capitalize(), "size")), _word(at + offset(field.capitalize(), field))
    return [_word(first + 8 * k) for k in range(count)]


def _is_metadata(extension: int) -> bool:
    kind = ctypes.c_int32.from_address(extension + offset("Extension_Base", "type")).value
    return kind == NUMBERS["XLA_FFI_Extension_Metadata"]


def _answer_version(metadata: int) -> None:
    if _word(metadata) < offset("Metadata"):
        raise ValueError("XLA's metadata are smaller than those of its interface")
    version = metadata + offset("Metadata", "api_version")
    ctypes.c_uint64.from_address(version).value = offset("Api_Version")
    ctypes.c_uint64.from_address(version + offset("Api_Version", "extension_start")).value = 0
    for field, number in zip(("major_version", "minor_version"), VERSION, strict=True):
        ctypes.c_int32.from_address(version + offset("Api_Version", field)).value = number
    ctypes.c_int32.from_address(metadata + offset("Metadata", "traits")).value = 0


def _of_api(frame: int, function: str) -> Callable[..., Any]:
    api = _word(frame + offset("CallFrame", "api"))
    return _handler_type(_word(api + offset("Api", function)))


def _stream(frame: int) -> int:
    """The stream that the call belongs to."""
    asked = (ctypes.c_uint64 * (offset("Stream_Get_Args") // 8))(offset("Stream_Get_Args"))
    asked[offset("Stream_Get_Args", "ctx") // 8] = _word(frame + offset("CallFrame", "ctx"))
    if _of_api(frame, "XLA_FFI_Stream_Get")(ctypes.addressof(asked)):
        raise RuntimeError("XLA gives no stream")
    return asked[offset("Stream_Get_Args", "stream") // 8]


def _error(frame: int, sentence: str) -> int | None:
    """The address of an error of XLA's."""
    said = ctypes.create_string_buffer(sentence.encode())
    asked = ctypes.create_string_buffer(offset("Error_Create_Args"))
    at = ctypes.addressof(asked)
    ctypes.c_uint64.from_address(at).value = offset("Error_Create_Args")
    ctypes.c_uint64.from_address(at + offset("Error_Create_Args", "message")).value = ctypes.addressof(said)
    ctypes.c_int32.from_address(at + offset("Error_Create_Args", "errc")).value = NUMBERS["XLA_FFI_Error_Code_INTERNAL"]
    return _of_api(frame, "XLA_FFI_Error_Create")(at)
