"""Object code for a target from a module of LLVM's intermediate representation."""

import ctypes
import hashlib
import importlib.metadata
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from .._compat import without_lock
from ..jaxprs.scalar_interpreter import Unsupported
from .interface import VERSION
from .target import SPLITTING, Target, llvm


if TYPE_CHECKING:
    from llvmlite.binding import ModuleRef, TargetMachine

# Of LLVM's passes. Loops become ones of vectors; straight-line code does not, which gains nothing here, and LLVM 22.1 breaks some
# functions by it. Nor are loops unrolled and interleaved: a system of 3,000 unknowns by Radau was ready in 23 s so, in 9.5 without,
# and took as long.
SPEED = 2
TUNING = {"loop_vectorization": True, "slp_vectorization": False, "loop_unrolling": False, "loop_interleaving": False}
# Modules of more lines become machine code as they are: LLVM's passes would take 6 s and more.
HEAVY = 45_000
# And modules that compute so many addresses, or have so many loops: what LLVM's passes take grows with the memory that is written to, and
# by 10 ms with each loop, and what they gained there were loops of vectors, as which loops are written now. A heat equation of 900
# unknowns by Radau (490 loops) is ready in 6.3 s without them and in 11.4 with, and takes as long, a chain of 24 pendulums (480) in 5.3 and
# 10.4; the car axis by Radau (260 loops, 3,100 addresses) in 4.9 and 7.0, but takes 16 and 6 ms; Andrews' mechanism by Radau (460) in 14
# and 23, 21 and 14 ms. Measured on a busy machine.
ADDRESSES, LOOPS = 4_000, 400


# From as many lines on what is only looked at, as the start and the end of a solve, is made in the least time: of a four-bar linkage in
# space (49,000) in 1.9 s in place of 5.
LONG_LOOK = 10_000
# From as many on any program is: the derivatives of Andrews' mechanism by dummy derivatives (248,000 and 275,000) are ready in 45 s and
# take 50 ms, in place of 81 s and 30 ms. XLA, which they were left to before, had not compiled them in four minutes.
LONG = 200_000

# Where the index of a loop over an array begins.
_LOOP = "= phi i64 [ 0,"


def key(text: str, target: Target, optimise: bool) -> str:
    """What object code depends on: the module, the target, the effort, and the versions of all that is involved."""
    versions = (importlib.metadata.version(name) for name in ("dae_jax", "llvmlite"))
    made = (
        *versions,
        llvm().llvm_version_info,
        VERSION,
        target,
        optimise,
        SPEED,
        TUNING,
        HEAVY,
        ADDRESSES,
        LOOPS,
        SPLITTING,
        text,
    )
    return hashlib.sha256(repr(made).encode()).hexdigest()


class Module(NamedTuple):
    """A module that is not broken, the machine that it is for, and whether LLVM's passes run over it."""

    ir: "ModuleRef"
    machine: "TargetMachine"
    passes: bool


def verified(text: str, target: Target, optimise: bool = True) -> Module:
    """A module that can become machine code; with `optimise=False` in the least time.

    Errors: `Unsupported` for a module that is broken.
    """
    passes = optimise and _gains_by_passes(text)
    try:
        return Module(parsed(text), target.machine(3 if passes else int(optimise)), passes)
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from error


def object_code(module: Module, show: Callable[[str, str], None] | None = None) -> bytes:
    """Machine code; may run in several threads at once, each with a module of its own. `show` gets the intermediate representation
    after the passes, and the assembly.
    """
    if module.passes:
        _optimise(module)
    if show is not None:
        show("optimised.ll", str(module.ir))
        # A module of its own: making assembly changes it.
        show("s", module.machine.emit_assembly(parsed(str(module.ir))))
    return _emitted(module)


def _gains_by_passes(text: str) -> bool:
    """Whether LLVM's passes gain more than they take."""
    return text.count("\n") < HEAVY and text.count("getelementptr") < ADDRESSES and text.count(_LOOP) <= LOOPS


def parsed(text: str) -> Any:
    """A module in a context of its own, which goes with it; verified, since the passes end the process where it is broken."""
    module = llvm().parse_assembly(text, llvm().create_context())
    module.verify()
    return module


def _optimise(module: Module) -> None:
    tuning = llvm().create_pipeline_tuning_options(speed_level=SPEED)
    for name, value in TUNING.items():
        setattr(tuning, name, value)
    passes = llvm().create_pass_builder(module.machine, tuning)
    run = without_lock(llvm().ffi.lib.LLVMPY_RunNewModulePassManager)
    run(passes.getModulePassManager(), module.ir, passes)


def _emitted(module: Module) -> bytes:
    lib = llvm().ffi.lib
    with llvm().ffi.OutputString() as said:
        found = without_lock(lib.LLVMPY_TargetMachineEmitToMemory)(module.machine, module.ir, 1, said)
        if not found:
            raise RuntimeError(f"LLVM makes no machine code of a module: {said}")
    try:
        return ctypes.string_at(lib.LLVMPY_GetBufferStart(found), lib.LLVMPY_GetBufferSize(found))
    finally:
        lib.LLVMPY_DisposeMemoryBuffer(found)
