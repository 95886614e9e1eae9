"""What became of a function, to look at: jaxpr, annotated form, instructions, machine code, and what was in the way."""

import dataclasses
import warnings

from jax.extend.core import ClosedJaxpr

from . import lower
from .emit.object_code import object_code, verified
from .emit.target import host
from .jaxprs.scalar_interpreter import Unsupported
from .jaxprs.walk import equations
from .kernel_call import decision
from .settings import current


_WORDS = {
    "llvm": "one kernel by our compiler (LLVM)",
    "xla kernel": "one kernel by XLA",
    "xla": "many kernels by XLA, as `jax.jit` has it",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Lowered:
    """How a function is compiled; `print` it.

    - `jaxpr`: the function as JAX traces it.
    - `kernel`: the function that is compiled: without checks, and with expansions in place of what they stand for.
    - `compiler`: "llvm", one kernel by our compiler; "xla kernel", one by XLA; "xla", XLA as `jax.jit` has it.
    - `unsupported`: what our compiler does not take, each with `reason`, `equation` and `primitive`; empty if nothing.
    - `checks`: the messages of those that raise when the kernel is done.
    - `batched`: of a batch, which arguments have a leading axis.
    """

    jaxpr: ClosedJaxpr
    kernel: ClosedJaxpr
    compiler: str
    unsupported: tuple[Unsupported, ...]
    checks: tuple[str, ...] = ()
    batched: tuple[bool, ...] = ()

    @property
    def lanes(self) -> tuple[bool, ...]:
        """The former name of `batched`."""
        warnings.warn("`lanes` of what is lowered is called `batched` now.", DeprecationWarning, stacklevel=2)
        return self.batched

    @classmethod
    def of(
        cls, jaxpr: ClosedJaxpr, kernel: ClosedJaxpr, checks: tuple[str, ...] = (), batched: tuple[bool, ...] = ()
    ) -> "Lowered":
        """What becomes of `kernel`, which comes from `jaxpr`."""
        found = decision(kernel, batched)
        return cls(jaxpr, kernel, found.compiler, found.unsupported, checks, batched)

    def batch(self) -> "Lowered":
        """The same for a batch of all arguments, as `jax.vmap` makes it."""
        return self.of(self.jaxpr, self.kernel, self.checks, (True,) * len(self.kernel.jaxpr.invars))

    def annotated(self) -> str:
        """Each equation as our compiler takes it: uniform or varying over lanes, in registers or memory, and its cost."""
        return str(lower.annotate(self.kernel, self.batched))

    def ir(self) -> str:
        """LLVM's intermediate representation, before its passes. Errors: `Unsupported` where our compiler does not take it."""
        return lower.written(self.kernel, self.batched).replace("{name}", "kernel")

    def assembly(self) -> str:
        """The machine code in words. Errors: as `ir`."""
        found: dict[str, str] = {}
        object_code(verified(self.ir(), host(), current().optimise), show=found.__setitem__)
        return found["s"]

    def __repr__(self) -> str:
        count = len(equations(self.kernel))
        batch = ", a batch as lanes of vectors" if any(self.batched) else ""
        lines = [f"{_WORDS[self.compiler]}{batch}: {count} equations"]
        lines += [f"  not taken by our compiler: {reason}" for reason in self.unsupported]
        if self.checks:
            lines.append("  what is checked raises when it is done: see `checks`")
        return "\n".join(lines)
