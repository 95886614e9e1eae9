"""Small functions as subroutines of the compiled program."""

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import PyTree


def subroutine(fn: Callable[..., Any], **jit_options: Any) -> Callable[..., Any]:
    """`jax.jit(fn, **jit_options)` that on the CPU stays a call where it is called from a larger program.

    Inlined, XLA would fuse what produces an argument into each of its uses: the linear combination of a Runge–Kutta
    stage was computed three times over (double pendulum, DOP853: 280 ns a step against 230).
    """

    def body(*args: PyTree) -> Any:
        # What fn calls is inlined; XLA would share out the last operation of a function with a single result among
        # threads if that is large, which cannot be done inside a kernel.
        with set_xla_metadata(inlineable=None, xla_cpu_small_call=None):
            return fn(*args), jnp.zeros(())

    call = jax.jit(body, **jit_options)

    @functools.wraps(fn)
    def called(*args: PyTree) -> Any:
        on_cpu = jax.default_backend() == "cpu"
        with set_xla_metadata(inlineable="false") if on_cpu else contextlib.nullcontext():
            return call(*args)[0]

    return called
