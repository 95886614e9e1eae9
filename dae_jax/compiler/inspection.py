"""What became of a function, to look at: jaxpr, annotated form, instructions, machine code, and what was in the way."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Lowered:
    jaxpr: Any
    kernel: Any
    compiler: str
    unsupported: tuple[Any, ...]

    @classmethod
    def of(cls, jaxpr: Any, kernel: Any) -> "Lowered":
        from .kernel_call import hindrances

        from .jaxprs.expansions import expanded
        kernel=expanded(kernel)
        found = hindrances(kernel)
        return cls(jaxpr, kernel, "llvm" if not found else "xla", found)
