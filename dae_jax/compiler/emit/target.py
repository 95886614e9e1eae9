"""The machines that code is made for, as data: the host, with the vectors that it has or fewer, and others."""

import ctypes
import dataclasses
import functools
import importlib
import platform
from typing import Any

from ..settings import current


# The x86-64 instruction sets, by rising size of a vector: (LLVM's processor, numbers of 64 bits in a vector).
ISAS = {"sse2": ("x86-64", 2), "avx2": ("x86-64-v3", 4), "avx512": ("x86-64-v4", 8)}
# What the C library's functions for vectors have in their names (glibc's vector ABI).
_VECTOR_ABI = {("x86_64", 2): "b", ("x86_64", 4): "d", ("x86_64", 8): "e", ("aarch64", 2): "n"}


# How many edges between blocks LLVM looks at (10,000 by default) for where best to split what lives in a register, and its versions that
# have the option. A function of 150,000 lines becomes machine code in 5.3 s in place of 7.4, of the same size and speed.
SPLITTING, SPLITTING_KNOWN = 100, range(20, 23)


@dataclasses.dataclass(frozen=True)
class Target:
    """A machine: LLVM's names for it, and how many numbers of 64 bits its vectors hold.

    - `threads`: an element of a batch is a thread of its own, not a lane of a vector; `width` is 1 then.
    - `library`: what the names of its C library's functions begin with.
    """

    triple: str
    cpu: str
    features: str
    width: int
    threads: bool = False
    library: str = ""

    @property
    def is_gpu(self) -> bool:
        return self.triple.startswith("nvptx")

    @property
    def vector_abi(self) -> str | None:
        """The letter of this machine's vectors in the names of the C library's functions."""
        machine = self.triple.partition("-")[0].replace("arm64", "aarch64")
        return _VECTOR_ABI.get((machine, self.width)) if "linux" in self.triple else None

    def machine(self, effort: int = 3) -> Any:
        """LLVM's object of it; an execution engine takes it over, so that each needs its own."""
        return (
            llvm()
            .Target.from_triple(self.triple)
            .create_target_machine(cpu=self.cpu, features=self.features, opt=effort, codemodel="jitdefault", jit=True)
        )


def compiles_here() -> bool:
    """Whether this is a system that code can be made for."""
    return platform.system() in ("Linux", "Darwin") and ctypes.sizeof(ctypes.c_void_p) == 8


@functools.cache
def llvm() -> Any:
    """LLVM, loaded when it is first needed."""
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    # An option that LLVM does not know ends the process.
    if binding.llvm_version_info[0] in SPLITTING_KNOWN:
        binding.set_option("dae_jax", f"-grow-region-complexity-budget={SPLITTING}")
    return binding


def host() -> Target:
    """This machine, with the instruction set that the settings ask for."""
    return _host(current().isa)


@functools.cache
def _host(isa: str | None) -> Target:
    features = llvm().get_host_cpu_features()
    triple = llvm().get_process_triple()
    own = "avx512" if features.get("avx512f") else "avx2" if features.get("avx2") else "sse2"
    if isa in (None, own):
        width = ISAS[own][1]
        return Target(triple, llvm().get_host_cpu_name(), features.flatten(), width)
    names = list(ISAS)
    if not triple.startswith("x86_64") or names.index(isa) > names.index(own):
        has = f"has {own}" if triple.startswith("x86_64") else "is none of x86-64"
        raise ValueError(
            f"`isa` is {isa!r}, but this machine {has}: take none, or one of {names[: names.index(own) + 1]}."
        )
    cpu, width = ISAS[isa]
    return Target(triple, cpu, "", width)


def vector_size() -> int:
    """How many numbers of 64 bits the machine's vectors hold."""
    return host().width
