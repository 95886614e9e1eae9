"""Settings of the compilation: from the environment when they are first needed, or by `configure`."""

import contextlib
import ctypes
import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from ._compat import backends_are_initialised, setting


COMPILERS = ("llvm", "xla", "off")
ISAS = ("sse2", "avx2", "avx512")
# Units in the last place of an array's largest number by which two compilers may differ where `check` does not say how many.
UNITS = 4096


@dataclasses.dataclass(frozen=True)
class Settings:
    """How functions are compiled; `configure` explains the fields."""

    compiler: str = "llvm"
    check: int = 0
    dump: str | None = None
    isa: str | None = None
    optimise: bool = True


# Part of the key of JAX's caches: what was compiled with other settings is compiled again.
_context = jax.make_user_context(None)
# How many threads a batch may take: read by the compiled code at each call.
THREADS = ctypes.c_int64(os.cpu_count() or 1)


def current() -> Settings:
    """The settings that hold here."""
    return _context.value or _from_environment()


def one_kernel_enabled() -> bool:
    """Whether solves that are traced now may become one kernel, on the CPU or a GPU; what JAX is told not to compile does not."""
    here = jax.default_backend() in ("cpu", "gpu")
    return here and current().compiler != "off" and not setting("jax_disable_jit")


def processors() -> int:
    """How many threads may compute at a time: those of the settings, and no more than the process has processors for."""
    current()
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(own, THREADS.value)


@functools.cache
def _from_environment() -> Settings:
    settings, threads = read(os.environ)
    if threads is not None:
        THREADS.value = threads
    return settings


def read(environment: Mapping[str, str]) -> tuple[Settings, int | None]:
    """The settings that the variables DAE_JAX_COMPILER, _CHECK, _DUMP, _ISA, _OPTIMISE and _THREADS ask for.

    Errors: `ValueError` for a value that none of them takes.
    """
    fields = ("compiler", "check", "dump", "isa", "optimise", "threads")
    given = {field: environment.get(f"DAE_JAX_{field.upper()}") for field in fields}
    numbers: dict[str, Any] = {}
    for field in ("check", "optimise", "threads"):
        text = given.pop(field)
        if text:
            if not text.strip().isdecimal():
                raise ValueError(f"DAE_JAX_{field.upper()} must be a whole number, but is {text!r}.")
            numbers[field] = int(text)
    values: dict[str, Any] = {field: text for field, text in given.items() if text}
    if "check" in numbers:
        values["check"] = _units(numbers["check"])
    if "optimise" in numbers:
        values["optimise"] = _switch(numbers["optimise"], "DAE_JAX_OPTIMISE")
    threads = _count(numbers["threads"], "DAE_JAX_THREADS") if "threads" in numbers else None
    return _checked(Settings(), values, lambda field: f"DAE_JAX_{field.upper()}"), threads


def configure(
    *,
    one_kernel: bool | None = None,
    compiler: str | None = None,
    check: bool | int | None = None,
    dump: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    isa: str | None = None,
    optimise: bool | None = None,
    process_wide: bool = False,
) -> contextlib.ExitStack:
    """Settings of the compilation, at once; used in a `with` statement, until its end.

    Those of the compiler hold in the thread that calls this; functions that were compiled with others are compiled again. Each
    but the last has an environment variable: `DAE_JAX_COMPILER`, `DAE_JAX_CHECK`, and so on.

    - `compiler`: who makes machine code of a loop: `"llvm"`, our own compiler where it can, else XLA's single kernel; `"xla"`,
      XLA's alone; `"off"`, JAX as it is. `one_kernel=False` is the latter too.
    - `check`: each kernel is computed by plain XLA too, and a difference raises: of integers, booleans and NaN any, of floats one
      of more than 4096 units in the last place of the array's largest number, or of `check` units. A solve whose equations are
      chaotic differs by more.
    - `dump`: a folder for what is compiled: the jaxpr, LLVM's intermediate representation before and after its passes, assembly.
    - `threads`: at most so many for a batch, and no more than the processors that the process may use; in the whole process.
    - `isa`: `"sse2"`, `"avx2"` or `"avx512"` for less than what this machine has.
    - `optimise`: `False` for machine code that is ready in a tenth of the time, without LLVM's passes, and takes three to five times
      as long: for tests, and where each solve runs a few times. Results differ by rounding.
    - `process_wide`: for programs that solve many small problems. Every small loop of the process is compiled to one kernel,
      also those of other libraries, and a computation runs in the thread that calls it, which saves the 10 to 50 µs of handing
      it to another. Call it before JAX computes anything.

    Errors: `ValueError` for a value that a setting does not take; `RuntimeError` where JAX has computed something before a
    process-wide setting.
    """
    values: dict[str, Any] = {"compiler": compiler, "isa": isa, "dump": None if dump is None else os.fspath(dump)}
    if optimise is not None:
        values["optimise"] = _switch(optimise, "`optimise`")
    if one_kernel is not None:
        if compiler is not None and (compiler == "off") == one_kernel:
            raise ValueError(f"`one_kernel={one_kernel}` contradicts `compiler={compiler!r}`: give one of them.")
        values["compiler"] = compiler or ("llvm" if one_kernel else "off")
    if check is not None:
        values["check"] = _units(check)
    values = {field: value for field, value in values.items() if value is not None}
    new = _checked(current(), values, lambda field: f"`{field}`")
    count = None if threads is None else _count(threads, "`threads`")
    restore = contextlib.ExitStack()
    if values:
        restore.enter_context(_context(new))
    if count is not None:
        restore.callback(setattr, THREADS, "value", THREADS.value)
        THREADS.value = count
    if process_wide:
        _configure_process()
    return restore


def _units(check: object) -> int:
    if isinstance(check, bool) or check in (0, 1):
        return UNITS * int(check)
    if not isinstance(check, int) or check < 0:
        raise ValueError(f"`check` must be True, False or a number of units in the last place, but is {check!r}.")
    return check


def _switch(value: object, name: str) -> bool:
    if value not in (0, 1):
        raise ValueError(f"{name} must be true or false, 1 or 0, but is {value!r}.")
    return bool(value)


def _count(threads: object, name: str) -> int:
    if type(threads) is not int or threads < 1:
        raise ValueError(f"{name} must be a number of threads of at least 1, but is {threads!r}.")
    return threads


def _checked(base: Settings, values: dict[str, Any], named: Callable[[str], str]) -> Settings:
    for field, choices in (("compiler", COMPILERS), ("isa", ISAS)):
        if values.get(field) not in (None, *choices):
            raise ValueError(f"{named(field)} must be one of {', '.join(choices)}, but is {values[field]!r}.")
    if "dump" in values:
        try:
            Path(values["dump"]).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"{named('dump')} must be a folder that can be written to: {error}.") from None
    return dataclasses.replace(base, **values)


def _configure_process() -> None:
    if backends_are_initialised():
        raise RuntimeError(
            "`configure(process_wide=True)` comes too late: JAX has started already. Call it right after the imports."
        )
    options = "xla_cpu_small_while_loop_byte_threshold=65536,xla_cpu_use_multi_output_fusion"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_extra_options={options}"
    jax.config.update("jax_cpu_enable_async_dispatch", False)
