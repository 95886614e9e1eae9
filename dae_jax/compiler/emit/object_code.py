"""Object code for a target from a module of LLVM's intermediate representation."""

import hashlib
import importlib.metadata
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..jaxprs.scalar_interpreter import Unsupported
from .interface import VERSION
from .target import Target, llvm


if TYPE_CHECKING:
    from llvmlite.binding import ModuleRef, TargetMachine

# Of LLVM's passes. Without the vectorisation of straight-line code: it gains nothing here, and LLVM 22.1 breaks some
# functions by it; with that of loops.
SPEED = 2
BY_VECTORS = (False, True)
# Modules of more lines become machine code as they are: LLVM's passes would take 6 s and more. Straight-line code, as it is
# written for an explicit method, they hardly make faster; Andrews' mechanism by Radau (39,000 lines) takes 24 ms without them, 8
# with.
HEAVY = 45_000


def key(text: str, target: Target, passes: bool) -> str:
    """What object code depends on: the module, the target, the passes, and the versions of all that is involved."""
    versions = (importlib.metadata.version(name) for name in ("dae_jax", "llvmlite"))
    made = (*versions, llvm().llvm_version_info, VERSION, target, passes, SPEED, BY_VECTORS, HEAVY, text)
    return hashlib.sha256(repr(made).encode()).hexdigest()


def object_code(
    text: str, target: Target, passes: bool = True, show: Callable[[str, str], None] | None = None
) -> bytes:
    """Machine code of a module; without `passes` it is made in the least time. `show` gets the intermediate representation after
    the passes, and the assembly.

    Errors: `Unsupported` for a module that is broken.
    """
    machine = target.machine(3 if passes else 0)
    try:
        module = parsed(text)
        if passes and text.count("\n") < HEAVY:
            _optimise(module, machine)
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from error
    if show is not None:
        show("optimised.ll", str(module))
        # A module of its own: making assembly changes it.
        show("s", machine.emit_assembly(parsed(str(module))))
    return machine.emit_object(module)


def parsed(text: str) -> Any:
    """A module in a context of its own, which goes with it; verified, since the passes end the process where it is broken."""
    module = llvm().parse_assembly(text, llvm().create_context())
    module.verify()
    return module


def _optimise(module: "ModuleRef", machine: "TargetMachine") -> None:
    tuning = llvm().create_pipeline_tuning_options(speed_level=SPEED)
    tuning.slp_vectorization, tuning.loop_vectorization = BY_VECTORS
    passes = llvm().create_pass_builder(machine, tuning)
    passes.getModulePassManager().run(module, passes)
