"""Small functions as subroutines of the compiled program."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata


def subroutine(fn: Callable[..., Any], **jit_options: Any) -> Callable[..., Any]:
    """`jax.jit(fn, **jit_options)` that on the CPU stays a call where it is called from a larger program.

    Inlined, XLA would fuse what produces an argument into each of its uses: the linear combination of a Runge–Kutta
    stage was computed three times over (double pendulum, DOP853: 280 ns a step against 230).
    """
    call = jax.jit(fn, **jit_options)

    @functools.wraps(fn)
    def called(*args: Any) -> Any:
        if jax.default_backend() != "cpu":
            return call(*args)
        with set_xla_metadata(inlineable="false"):
            return call(*args)

    return called
