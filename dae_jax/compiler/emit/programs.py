"""Compiled functions in this process: each is made beside what goes on, loaded when it is called, and let go when others have taken its
room.
"""

import ctypes
import dataclasses
import functools
import hashlib
import logging
import os
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
from jaxtyping import Array

from ..settings import THREADS, current
from . import background, host_functions, object_cache
from .object_code import LONG, LONG_LOOK, key, object_code, parsed, verified
from .runtime import HANDLE, SHARE, STUBS, stubs, text as shared
from .target import Target, host, llvm


# Bytes that loaded programs take at a time: a solve has 20 to 300 kB of object code, and each an execution engine beside it.
BOUND = 64 * 2**20
ENGINE = 150_000

_log = logging.getLogger(__name__)
_lock = threading.RLock()
_programs: dict[str, "_Program"] = {}


def _before_fork() -> None:
    _lock.acquire()
    background.finish()


# A child process finds the lock free, and all that was begun.
os.register_at_fork(before=_before_fork, after_in_parent=_lock.release, after_in_child=_lock.release)


@dataclasses.dataclass
class _Program:
    """A function: where it is entered, its object code, which is being made until it is in the spill file, and what is loaded of it."""

    name: str
    slot: int
    handler: Any
    making: Future[bytes] | None
    size: int = 0
    place: tuple[Any, int] | None = None
    engine: Any = None

    @property
    def last_use(self) -> int:
        return ctypes.c_int64.from_address(self.slot + 16).value

    def has_failed(self) -> bool:
        """Whether LLVM has given up, as where memory was short."""
        return self.making is not None and self.making.done() and self.making.exception() is not None


def register(module: str, source: object = None, often: bool = True) -> str:
    """Begins to compile a module with a function `{name}.kernel`, and gives the name by which XLA calls it.

    `source` is what the module was written from, for people to read where the settings ask for a dump; `often`: whether how fast it is
    counts, if it does not take too long to compile.

    `module` is a format string for `{name}`, which is made of its contents: equal programs are compiled once, also where
    XLA's compilation cache holds the program that calls them.

    Errors: `Unsupported` for a module that is broken.
    """
    target, optimise = host(), current().optimise and module.count("\n") < (LONG if often else LONG_LOOK)
    name = "dae_jax_" + hashlib.sha256(f"{target} {optimise} {module}".encode()).hexdigest()[:32]
    text = module.replace("{name}", name)
    with _lock:
        if source is not None and current().dump is not None:
            _dump(text, target, name, source)
        program = _programs.get(name)
        if program is None:
            making = compiled(text, target, optimise)
            program = _Program(name, *_entrance(), making)
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(program.handler), platform="cpu")
            _programs[name] = program
        elif program.has_failed():
            program.making = compiled(text, target, optimise)
    return name


def handler(name: str) -> Callable[[int], int | None]:
    """The handler of a registered program, which takes the address of a call frame and gives that of an error."""
    return _programs[name].handler


def guarded(fn: Callable[..., Any]) -> Callable[..., Any]:
    """`fn`, in one thread at a time."""

    @functools.wraps(fn)
    def call(*args: Array) -> Any:
        with _lock:
            return fn(*args)

    return call


def compiled(text: str, target: Target, optimise: bool = True) -> Future[bytes]:
    """Object code, from the cache on disk where that has it, else when it is made.

    Errors: `Unsupported` for a module that is broken.
    """
    made_of = key(text, target, optimise)
    code = object_cache.load(made_of)
    if code is None:
        modules = [verified(text, target, optimise)]

        def make() -> bytes:
            # The module is gone before the code is there: a fork then finds no thread in LLVM.
            code = object_code(modules.pop())
            object_cache.keep(made_of, code)
            return code

        return background.begin(make)
    found: Future[bytes] = Future()
    found.set_result(code)
    return found


def _dump(text: str, target: Target, name: str, source: object) -> None:
    """Writes a module, what it was written from, what LLVM's passes make of it, and its assembly to the settings' folder."""

    def show(suffix: str, text: str) -> None:
        Path(current().dump or "", f"{name}.{suffix}").write_text(text)

    show("jaxpr", str(source))
    show("ll", text)
    object_code(verified(text, target, current().optimise), show=show)


def engine(code: bytes, target: Target) -> Any:
    """The machine code of an object file, in memory."""
    loaded = llvm().create_mcjit_compiler(parsed(""), target.machine())
    loaded.add_object_file(llvm().ObjectFileRef.from_data(code))
    loaded.finalize_object()
    return loaded


class Runtime:
    """What all programs share, loaded."""

    def __init__(self) -> None:
        target = host()
        self.engine = engine(compiled(shared(), target, optimise=False).result(), target)
        address = self.engine.get_function_address
        for name in (HANDLE, SHARE):
            llvm().add_symbol(name, address(name))
        llvm().add_symbol(host_functions.HOST, ctypes.cast(host_functions.run, ctypes.c_void_p).value)
        self.fill = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(address("fill"))
        self.release = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)(address("release"))
        self.clock = ctypes.c_int64.from_address(self.engine.get_global_value_address("clock"))
        self._loader = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)(_fetch)
        for name, value in (
            ("limit.at", ctypes.addressof(THREADS)),
            ("loader", ctypes.cast(self._loader, ctypes.c_void_p).value),
        ):
            ctypes.c_void_p.from_address(self.engine.get_global_value_address(name)).value = value
        os.register_at_fork(after_in_child=ctypes.CFUNCTYPE(None)(address("forked")))
        self.stubs = compiled(stubs(), target, optimise=False).result()
        self.entrances: list[tuple[int, Any]] = []


@functools.cache
def runtime() -> Runtime:
    """The runtime of this process."""
    return Runtime()


# The engines of the handlers, which XLA keeps for the life of the process.
_stub_engines: list[Any] = []


def _entrance() -> tuple[int, Callable[..., Any]]:
    """A slot and its handler."""
    free = runtime().entrances
    if not free:
        block = engine(runtime().stubs, host())
        _stub_engines.append(block)
        slots = block.get_global_value_address("slots")
        handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
        free += [(slots + 64 * k, handler(block.get_function_address(f"stub{k}"))) for k in reversed(range(STUBS))]
    return free.pop()


def _load(program: _Program, code: bytes) -> None:
    program.engine = engine(code, host())
    shared = runtime()
    shared.clock.value += 1
    shared.fill(program.slot, program.engine.get_function_address(f"{program.name}.kernel"))
    loaded = [p for p in _programs.values() if p.engine is not None and p is not program]
    total = sum(p.size + ENGINE for p in (program, *loaded))
    for old in sorted(loaded, key=lambda p: p.last_use):
        if total <= BOUND:
            return
        if old.place is not None and shared.release(old.slot):
            old.engine.close()
            old.engine = None
            total -= old.size + ENGINE


def _fetch(slot: int) -> int:
    """Called by the handler of a program whose code is not loaded, or no more; 0 where it cannot be."""
    program = next((p for p in list(_programs.values()) if p.slot == slot), None)
    if program is None:
        return 0
    making = program.making
    # Others go on meanwhile.
    wrong = None if making is None else making.exception()
    if wrong is not None:
        # What is raised in here would be lost.
        _log.error("%s could not be compiled: %r", program.name, wrong)
        return 0
    with _lock:
        if program.engine is None:
            code = _code(program)
            if code is None:
                return 0
            _load(program, code)
    return 1


def _code(program: _Program) -> bytes | None:
    """The object code of a program that is not loaded; `None` where it cannot be read."""
    if program.making is not None:
        code = program.making.result()
        program.size, program.place, program.making = len(code), _spilled(code), None
        return code
    if program.place is None:
        return None
    file, start = program.place
    code = os.pread(file.fileno(), program.size, start)
    return code if len(code) == program.size else None


# Where the object code of this process is kept: files without a name, which end with the process.
_spills: list[Any] = []
os.register_at_fork(after_in_child=_spills.clear)


def _spilled(code: bytes) -> tuple[Any, int] | None:
    """The file that the object code was written to, and where in it; `None` where there is no room."""
    try:
        if not _spills:
            _spills.append(tempfile.TemporaryFile())  # noqa: SIM115
        file = _spills[-1]
        start = file.seek(0, os.SEEK_END)
        file.write(code)
        file.flush()
    except OSError:
        return None
    return file, start
