"""Kernels on NVIDIA's GPUs, where an element of a batch is a thread: whether they are made, and whether they can be trusted there."""

import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from . import lower
from ._compat import setting
from .check import refuse_difference
from .emit.ptx import target
from .emit.target import Target
from .jaxprs.expansions import kernel_written_out


# Units in the last place by which a kernel of the self-test may differ from XLA's.
UNITS = 64


@functools.cache
def gpu() -> Target | None:
    """The GPUs that JAX has, as one target; `None` where there are none, or where kernels do not work on them, which is said once."""
    try:
        devices = jax.local_devices(backend="cuda")
    except RuntimeError:
        return None
    try:
        found = target(min(int(float(d.compute_capability) * 10 + 0.5) for d in devices))
        for device in devices:
            _test(found, device)
    except Exception as error:  # whatever the driver, LLVM, ctypes or XLA say: there is another way
        warnings.warn(
            f"dae_jax leaves all kernels on GPUs to XLA, as its own do not work here: {error!r}",
            RuntimeWarning,
            stacklevel=2,
        )
        return None
    return found


def _solve(turns: Array, x: Array) -> Array:
    """A loop of as many turns as the element asks for, with a table, a branch, integers and functions of the C library."""

    def turn(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        k, x, table = carry
        moved = jax.lax.cond(k % 3 == 0, lambda x: jnp.sin(x) + x[::-1] / 3, lambda x: jnp.exp(-x * x) / 2 - 0.5, x)
        return k + 1, moved, table.at[(7 * k) % 40].add(jnp.sqrt(1 + moved[0] ** 2))

    k, x, table = jax.lax.while_loop(
        lambda carry: carry[0] < turns, turn, (jnp.zeros_like(turns), x, jnp.zeros(40, x.dtype))
    )
    return jnp.concatenate([x, table, jnp.array([jnp.fmod(3 * x[0], 0.7), k], x.dtype)])


def _test(to: Target, device: Any) -> None:
    """Raises where a batch is computed otherwise than by XLA."""
    rng = np.random.default_rng(0)
    turns = rng.integers(0, 60, 1000).astype(np.int32)
    for dtype in (np.float32, np.float64) if setting("jax_enable_x64") else (np.float32,):
        x = rng.normal(size=(1000, 2)).astype(dtype)
        jaxpr = jax.make_jaxpr(_solve)(turns[0], x[0])
        by_xla = functools.partial(kernel_written_out, jaxpr=jaxpr, batched=(True, True))
        with jax.default_device(device), jax.ensure_compile_time_eval():
            ours, theirs = (jax.jit(f)(turns, x) for f in (lower.compiled(jaxpr, (True, True), target=to), by_xla))
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            refuse_difference(k, np.asarray(a), np.asarray(b), UNITS)
