"""Programs run by our compiler, alone and in batches of two sizes, and by XLA."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dae_jax.compiler.emit import target
from dae_jax.compiler.lower import compiled, unsupported

from .compare import difference
from .numbers import Draw
from .programs import Program


WIDTH = target.vector_size()
BATCHES = (1, WIDTH, WIDTH + 1, 2 * WIDTH + 3)
# A quarter of the time to compile, and the same answers.
_QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}


@dataclasses.dataclass(frozen=True)
class Difference:
    program: Program
    result: int
    batch: int | None
    at: tuple[int, ...]
    found: Any
    wanted: Any

    def __str__(self) -> str:
        where = "alone" if self.batch is None else f"a batch of {self.batch}"
        return (
            f"{self.program.name}: result {self.result} of {where} at {self.at}: {self.found!r}, XLA: {self.wanted!r}"
        )


def arguments(program: Program) -> list[np.ndarray]:
    """Numbers for the largest batch."""
    draw = Draw(len(program.name), *program.name.encode())
    return [draw.numbers(o, () if s else BATCHES[-1:]) for o, s in zip(program.operands, program.shared, strict=True)]


@functools.cache
def _options() -> dict[str, Any]:
    """Of XLA's compiler, where it knows these."""
    try:
        jax.jit(jax.numpy.negative).lower(1.0).compile(_QUICK)
    except Exception:
        return {}
    return _QUICK


def by_xla(fn: Any, args: Sequence[Any], shared: Sequence[bool]) -> list[Any]:
    """Element after element."""
    batched = [x for x, s in zip(args, shared, strict=True) if not s]

    def all_elements(batched: Any, kept: Any) -> Any:
        def one(xs: Any) -> Any:
            rows, same = iter(xs), iter(kept)
            return fn(*(next(same) if s else next(rows) for s in shared))

        return jax.lax.map(one, batched)

    kept = [x for x, s in zip(args, shared, strict=True) if s]
    return jax.jit(all_elements).lower(batched, kept).compile(_options())(batched, kept)


def differences(programs: Sequence[Program]) -> list[Difference]:
    """What the programs, compiled together, give otherwise than by XLA. Errors: `Unsupported` for what the compiler refuses."""
    args = [arguments(p) for p in programs]
    ends = np.cumsum([len(a) for a in args]).tolist()

    def fn(*xs: Any) -> list[Any]:
        return [p.fn(*xs[end - len(p.operands) : end]) for p, end in zip(programs, ends, strict=True)]

    flat, shared = [x for a in args for x in a], [s for p in programs for s in p.shared]
    first = [x if s else x[0] for x, s in zip(flat, shared, strict=True)]
    jaxpr, shape = jax.make_jaxpr(fn, return_shape=True)(*first)
    if not_taken := unsupported(jaxpr):
        raise not_taken[0]
    wanted = jax.tree.leaves(by_xla(fn, flat, shared))
    of = [p for p, out in zip(programs, shape, strict=True) for _ in out]
    number = [k for out in shape for k in range(len(out))]
    found = []
    for copies in (False, True) if any(p.copies for p in programs) else (False,):
        for batch, results in _ours(jaxpr, flat, first, shared, copies):
            for p, k, x, y in zip(of, number, results, wanted, strict=True):
                y = np.asarray(y)[0 if batch is None else slice(batch)]
                at = difference(x, y, p.ulps, p.scale)
                if at is not None:
                    found.append(Difference(p, k, batch, at, np.asarray(x)[at], y[at]))
    return found


def _ours(jaxpr: Any, args: Any, first: Any, shared: Any, copies: bool) -> Any:
    yield None, jax.jit(compiled(jaxpr, (), copies))(*first)
    lanes = jax.jit(compiled(jaxpr, tuple(not s for s in shared), copies))
    for n in (BATCHES[len(args) % 3], BATCHES[-1]):
        yield n, lanes(*(x if s else x[:n] for x, s in zip(args, shared, strict=True)))
