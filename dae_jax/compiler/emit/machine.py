"""Machine code for the host from LLVM's intermediate representation, as a function that XLA calls.

XLA calls foreign functions through a C interface (xla/ffi/api/c_api.h): a call frame with the arguments' and the
results' buffers goes in, an error (null: none) comes out. The offsets below are those of its structures where pointers
have 64 bits.
"""

import contextlib
import ctypes
import functools
import hashlib
import importlib
import os
import platform
import threading
from pathlib import Path
from typing import Any

import jax

from ..jaxprs.scalar_interpreter import Unsupported


# The kernel gets the arrays of argument and result buffers. A call with an extension of type 1 asks for the version of
# the interface: the answer is that of the caller, since nothing but these offsets is used of it.
_HANDLER = """
define ptr @{name}(ptr %frame) {{
entry:
  %extension.at = getelementptr i8, ptr %frame, i64 8
  %extension = load ptr, ptr %extension.at
  %is.call = icmp eq ptr %extension, null
  br i1 %is.call, label %call, label %ask
ask:
  %type.at = getelementptr i8, ptr %extension, i64 8
  %type = load i32, ptr %type.at
  %asks = icmp eq i32 %type, 1
  br i1 %asks, label %answer, label %call
answer:
  %metadata.at = getelementptr i8, ptr %extension, i64 24
  %metadata = load ptr, ptr %metadata.at
  %api.at = getelementptr i8, ptr %frame, i64 16
  %api = load ptr, ptr %api.at
  %version.at = getelementptr i8, ptr %api, i64 32
  %version = load i64, ptr %version.at
  %version.to = getelementptr i8, ptr %metadata, i64 24
  store i64 %version, ptr %version.to
  ret ptr null
call:
  %args.at = getelementptr i8, ptr %frame, i64 72
  %args = load ptr, ptr %args.at
  %results.at = getelementptr i8, ptr %frame, i64 112
  %results = load ptr, ptr %results.at
  call void @{name}.kernel(ptr %args, ptr %results)
  ret ptr null
}}
"""
_DATA_OF_BUFFER = 24
_DIMENSIONS_OF_BUFFER = 40

# Of LLVM's passes. Without the vectorisation of straight-line code: it gains nothing here, and LLVM 22.1 breaks some
# functions by it; with that of loops.
_SPEED = 2
_BY_VECTORS = (False, True)
# Modules of more lines become machine code as they are: LLVM's passes would take 6 s and more. Straight-line code, as it is written
# for an explicit method, they hardly make faster; Andrews' mechanism by Radau (39,000 lines) takes 24 ms without them, 8 with.
HEAVY = 45_000

_lock = threading.Lock()
_engines: dict[str, Any] = {}


def available() -> bool:
    """Whether code for this host can be made."""
    return platform.system() in ("Linux", "Darwin") and ctypes.sizeof(ctypes.c_void_p) == 8


def buffer(array: str, k: int, name: str) -> list[str]:
    """The instructions that find the numbers of the k-th buffer of an array of buffers."""
    return [
        f"%{name}.at = getelementptr ptr, ptr {array}, i64 {k}",
        f"%{name}.buffer = load ptr, ptr %{name}.at",
        f"%{name}.data = getelementptr i8, ptr %{name}.buffer, i64 {_DATA_OF_BUFFER}",
        f"%{name} = load ptr, ptr %{name}.data",
    ]


def batch_size(name: str) -> list[str]:
    """The instructions that find %batch, the first dimension of the buffer that `buffer` found by this name."""
    return [
        f"%dims.at = getelementptr i8, ptr %{name}.buffer, i64 {_DIMENSIONS_OF_BUFFER}",
        "%dims = load ptr, ptr %dims.at",
        "%batch = load i64, ptr %dims",
    ]


def alone(body: list[str], longest: bool) -> list[str]:
    """The kernel that does what `body` says of the buffers %args and %results; `longest`: by the longest vectors."""
    width = '"prefer-vector-width"="512" ' if longest else ""
    return [f"define void @{{name}}.kernel(ptr %args, ptr %results) {width}{{", "entry:", *body, "ret void", "}"]


def in_threads(body: list[str], batched: int, enough: int) -> list[str]:
    """The same, done by as many threads as there are processors for it where the batch, the first dimension of argument
    `batched`, is large `enough`; %taken is a counter that the threads share.
    """
    others = 0
    if has_symbol("pthread_create"):
        others = (os.cpu_count() or 1) // jax.local_device_count("cpu") - 1
        if hasattr(os, "sched_getaffinity"):
            others = min(others, len(os.sched_getaffinity(0)) - 1)
    return [
        "declare i32 @pthread_create(ptr, ptr, ptr, ptr)",
        "declare i32 @pthread_join(i64, ptr)",
        "define ptr @{name}.thread(ptr %shared) {",
        "entry:",
        "%args = load ptr, ptr %shared",
        "%results.at = getelementptr ptr, ptr %shared, i64 1",
        "%results = load ptr, ptr %results.at",
        "%taken = getelementptr ptr, ptr %shared, i64 2",
        *body,
        "ret ptr null",
        "}",
        "define void @{name}.kernel(ptr %args, ptr %results) {",
        "entry:",
        "%shared = alloca [3 x i64]",
        "store ptr %args, ptr %shared",
        "%results.at = getelementptr ptr, ptr %shared, i64 1",
        "store ptr %results, ptr %results.at",
        "%taken = getelementptr ptr, ptr %shared, i64 2",
        "store i64 0, ptr %taken",
        *buffer("%args", batched, "arg"),
        *batch_size("arg"),
        f"%large = icmp sge i64 %batch, {enough}",
        *_started(max(others, 0)),
        "call ptr @{name}.thread(ptr %shared)",
        *_ended(max(others, 0)),
        "ret void",
        "}",
    ]


def _started(others: int) -> list[str]:
    lines = []
    for k in range(others):
        lines += [
            f"%thread{k} = alloca i64",
            f"%error{k}.at = alloca i32",
            f"store i32 1, ptr %error{k}.at",
            f"br i1 %large, label %create{k}, label %created{k}",
            f"create{k}:",
            f"%error{k} = call i32 @pthread_create(ptr %thread{k}, ptr null, ptr @{{name}}.thread, ptr %shared)",
            f"store i32 %error{k}, ptr %error{k}.at",
            f"br label %created{k}",
            f"created{k}:",
        ]
    return lines


def _ended(others: int) -> list[str]:
    lines = []
    for k in range(others):
        lines += [
            f"%failed{k} = load i32, ptr %error{k}.at",
            f"%started{k} = icmp eq i32 %failed{k}, 0",
            f"br i1 %started{k}, label %join{k}, label %ended{k}",
            f"join{k}:",
            f"%handle{k} = load i64, ptr %thread{k}",
            f"call i32 @pthread_join(i64 %handle{k}, ptr null)",
            f"br label %ended{k}",
            f"ended{k}:",
        ]
    return lines


@functools.cache
def _llvm() -> Any:
    """LLVM, loaded when it is first needed."""
    llvm = importlib.import_module("llvmlite.binding")
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@functools.cache
def host() -> Any:
    """The machine that code is made for."""
    llvm = _llvm()
    features = llvm.get_host_cpu_features().flatten()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=3, codemodel="jitdefault", jit=True
    )


@functools.cache
def vector_size() -> int:
    """How many numbers of 64 bits the host's vectors hold."""
    features = _llvm().get_host_cpu_features()
    return 8 if features.get("avx512f") else 4 if features.get("avx2") else 2


@functools.cache
def has_symbol(name: str) -> bool:
    """Whether the process has a function of the C library by this name."""
    return hasattr(ctypes.CDLL(None), name)


@functools.cache
def _vector_library() -> Any:
    try:
        library = ctypes.CDLL("libmvec.so.1")
    except OSError:
        return None
    _llvm().load_library_permanently("libmvec.so.1")
    return library


@functools.cache
def vector_function(name: str, arguments: int) -> str | None:
    """The C library's function of this name for vectors of doubles, right to a few units in the last place."""
    width = vector_size()
    kind = {2: "b", 4: "d", 8: "e"}[width]
    full = f"_ZGV{kind}N{width}{'v' * arguments}_{name}"
    return full if hasattr(_vector_library(), full) else None


def register(module: str) -> str:
    """Compiles a module with a function `{name}.kernel`, and gives the name by which XLA calls it.

    `module` is a format string for `{name}`, which is made of its contents: equal programs are compiled once, also where
    XLA's compilation cache holds the program that calls them.
    """
    name = "dae_jax_" + hashlib.sha256(module.encode()).hexdigest()[:32]
    with _lock:
        if name not in _engines:
            _engines[name] = _compiled(module.replace("{name}", name) + _HANDLER.format(name=name))
            address = _engines[name].get_function_address(name)
            handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(address)
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")
            _engines[name, "handler"] = handler
    return name


def _compiled(text: str) -> Any:
    llvm = _llvm()
    # By way of an object file, so that no more than the code is kept.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), host())
    engine.add_object_file(llvm.ObjectFileRef.from_data(_object_code(text)))
    engine.finalize_object()
    return engine


def _object_code(text: str) -> bytes:
    """Machine code, from JAX's compilation cache where that has it."""
    kept = _cached(text)
    if kept is not None:
        with contextlib.suppress(OSError):
            return kept.read_bytes()
    machine, llvm = host(), _llvm()
    try:
        module = llvm.parse_assembly(text)
        # The passes end the process where a module is broken.
        module.verify()
        if text.count("\n") < HEAVY:
            _optimise(module)
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from error
    code = machine.emit_object(module)
    if kept is not None:
        with contextlib.suppress(OSError):
            unfinished = kept.with_suffix(f".{os.getpid()}")
            unfinished.write_bytes(code)
            unfinished.replace(kept)
    return code


def _optimise(module: Any) -> None:
    tuning = _llvm().create_pipeline_tuning_options(speed_level=_SPEED)
    tuning.slp_vectorization, tuning.loop_vectorization = _BY_VECTORS
    passes = _llvm().create_pass_builder(host(), tuning)
    passes.getModulePassManager().run(module, passes)


def _cached(text: str) -> Path | None:
    """Where JAX's compilation cache keeps the machine code of a module, if there is such a cache."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder or "://" in folder or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    llvm = _llvm()
    features = llvm.get_host_cpu_features().flatten()
    made_for = f"{llvm.llvm_version_info} {llvm.get_host_cpu_name()} {features} {_SPEED} {_BY_VECTORS} {text}"
    return Path(folder) / f"dae_jax-{hashlib.sha256(made_for.encode()).hexdigest()}.o"
