"""NVIDIA's GPUs as targets: PTX, the code that their driver takes, from LLVM's intermediate representation.

The functions of the C library are libdevice's, which comes with JAX's packages for CUDA or with CUDA's compiler.
"""

import functools
import importlib.util
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..jaxprs.scalar_interpreter import Unsupported
from .target import Target, llvm


# The architectures that LLVM is asked for; the driver makes code of a newer one from that of an older one.
ARCHITECTURES = (70, 75, 80, 86, 89, 90)
_SPEED = 3


def target(capability: int) -> Target:
    """A GPU of this compute capability, such as 90 for 9.0.

    Errors: `Unsupported` below 7.0, which JAX does not serve any more.
    """
    if capability < ARCHITECTURES[0]:
        raise Unsupported(f"a GPU of compute capability {capability / 10}", primitive="system")
    newest = max(a for a in ARCHITECTURES if a <= capability)
    return Target("nvptx64-nvidia-cuda", f"sm_{newest}", "", 1, threads=True, library="__nv_")


def kernel(body: list[str], arguments: int, results: int, room: int) -> list[str]:
    """The kernel that does what `body` says for the elements from %first to %batch in steps of %threads.

    `room`: bytes that each thread has of the buffer %room, which comes after the results.
    """
    parameters = [f"ptr noalias readonly %arg{k}" for k in range(arguments)]
    parameters += [f"ptr noalias %result{k}" for k in range(results)]
    parameters += ["ptr noalias %room"] * (room > 0)
    registers = [f"@llvm.nvvm.read.ptx.sreg.{name}.x()" for name in ("tid", "ctaid", "ntid", "nctaid")]
    return [
        f"; room {room}",
        *(f"declare i32 {register}" for register in registers),
        f"define ptx_kernel void @{{name}}_kernel({', '.join([*parameters, 'i64 %batch'])}) {{",
        "entry:",
        *(f"%sreg{k} = call i32 {register}" for k, register in enumerate(registers)),
        *(f"%sreg{k}.wide = zext i32 %sreg{k} to i64" for k in range(4)),
        "%block = mul i64 %sreg1.wide, %sreg2.wide",
        "%first = add i64 %block, %sreg0.wide",
        "%threads = mul i64 %sreg2.wide, %sreg3.wide",
        *body,
        "ret void",
        "}",
    ]


def bytes_of_room(text: str) -> int:
    """How many bytes each thread of a module has of the buffer %room, which `kernel` has noted in it."""
    found = re.search(r"^; room (\d+)", text, re.MULTILINE)
    return int(found[1]) if found else 0


def ptx(text: str, to: Target) -> str:
    """A module as PTX. Errors: `Unsupported` for a module that is broken, or without libdevice."""
    library = libdevice()
    if library is None:
        raise Unsupported("libdevice, the functions of the C library for CUDA, is not there", primitive="system")
    binding = _binding()
    context = binding.create_context()
    machine = binding.Target.from_triple(to.triple).create_target_machine(cpu=to.cpu, features=to.features, opt=3)
    try:
        module = binding.parse_assembly(text, context)
        functions = binding.parse_bitcode(library, context)
        for each in (module, functions):
            each.triple, each.data_layout = to.triple, str(machine.target_data)
        module.verify()
        module.link_in(functions)
    except RuntimeError as error:
        raise Unsupported(f"LLVM: {error}") from error
    for function in module.functions:
        if not function.is_declaration and not function.name.endswith("_kernel"):
            function.linkage = "internal"
    tuning = binding.create_pipeline_tuning_options(speed_level=_SPEED)
    # Loops that are worth it are written out already; unrolled, a chain of 12 links takes four times as long to compile.
    tuning.slp_vectorization = tuning.loop_vectorization = tuning.loop_unrolling = False
    passes = binding.create_pass_builder(machine, tuning)
    passes.getModulePassManager().run(module, passes)
    return machine.emit_assembly(module)


@functools.cache
def _binding() -> Any:
    binding = llvm()
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    return binding


@functools.cache
def libdevice() -> bytes | None:
    """The functions of the C library, as LLVM's bitcode; `None` where they are not found."""
    found = next((path for folder in _folders() for path in folder.glob("nvvm/libdevice/libdevice.*.bc")), None)
    return None if found is None else found.read_bytes()


def _folders() -> Iterator[Path]:
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if variable in os.environ:
            yield Path(os.environ[variable])
    spec = importlib.util.find_spec("nvidia")
    for place in (spec and spec.submodule_search_locations) or ():
        yield from sorted(Path(place).glob("cu*"))
    yield Path("/usr/local/cuda")
