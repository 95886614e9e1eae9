"""Functions in the machine's code, as ones that JAX calls."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from ..emit import register
from ..emit.target import Target, host
from ..jaxprs.scalar_interpreter import Unsupported
from .judge import annotate, unsupported
from .module_text import module_text


def hindrances(jaxpr: ClosedJaxpr) -> tuple[str, ...]:
    """The names of what keeps a function from being compiled here; empty if nothing does."""
    return tuple(dict.fromkeys(found.primitive for found in unsupported(jaxpr)))


def written(jaxpr: ClosedJaxpr, batched: tuple[bool, ...] = (), always_copies: bool = False) -> str:
    """The module of a function; as `module_text` makes it. Errors: `Unsupported`, with what `annotate` finds."""
    return _written(jaxpr, batched, always_copies, host())


@functools.lru_cache(maxsize=2)
def _written(jaxpr: ClosedJaxpr, batched: tuple[bool, ...], always_copies: bool, _: Target) -> str:
    annotated = annotate(jaxpr, batched)
    if isinstance(annotated, Unsupported):
        raise annotated
    return module_text(annotated, always_copies) if always_copies or annotated.text is None else annotated.text


def compiled(jaxpr: ClosedJaxpr, batched: Sequence[bool] = (), always_copies: bool = False) -> Callable[..., list[Any]]:
    """The function as one that JAX calls; arguments and results as `written` has them."""
    name = register(written(jaxpr, tuple(batched), always_copies), jaxpr)
    first = list(batched).index(True) if any(batched) else None

    def call(*xs: Array) -> list[Any]:
        lead = () if first is None else (xs[first].shape[0],)
        structs = [jax.ShapeDtypeStruct((*lead, *v.aval.shape), v.aval.dtype) for v in jaxpr.jaxpr.outvars]
        return list(jax.ffi.ffi_call(name, structs)(*xs))

    return call
