"""Functions in the machine's code, as ones that JAX calls."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from ..emit import launch, register
from ..emit.target import Target, host
from ..jaxprs.scalar_interpreter import Unsupported
from .judge import annotate
from .module_text import module_text


def written(
    jaxpr: ClosedJaxpr, batched: tuple[bool, ...] = (), always_copies: bool = False, target: Target | None = None
) -> str:
    """The module of a function; as `module_text` makes it, for a `target`, this machine if none is given.

    Errors: `Unsupported`, with what `annotate` finds.
    """
    return _written(jaxpr, batched, always_copies, target or host())


@functools.lru_cache(maxsize=8)
def _written(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], always_copies: bool, target: Target) -> str:
    annotated = annotate(jaxpr, batched, target)
    if isinstance(annotated, Unsupported):
        raise annotated
    return module_text(annotated, always_copies) if always_copies or annotated.text is None else annotated.text


def compiled(
    jaxpr: ClosedJaxpr,
    batched: Sequence[bool] = (),
    always_copies: bool = False,
    target: Target | None = None,
    often: bool = True,
) -> Callable[..., list[Any]]:
    """The function as one that JAX calls; arguments and results as `written` has them, `often` as `register`."""
    text = written(jaxpr, tuple(batched), always_copies, target)
    first = list(batched).index(True) if any(batched) else None
    name = register(text, jaxpr, often) if target is None else launch.register(text, target, first)

    def call(*xs: Array) -> list[Any]:
        lead = () if first is None else (xs[first].shape[0],)
        structs = [jax.ShapeDtypeStruct((*lead, *v.aval.shape), v.aval.dtype) for v in jaxpr.jaxpr.outvars]
        room = 0 if target is None else launch.kernel(name).room_for(*lead or (1,))
        structs += [jax.ShapeDtypeStruct((room,), np.uint8)] if room else []
        return list(jax.ffi.ffi_call(name, structs)(*xs))[: len(jaxpr.jaxpr.outvars)]

    return call
