"""A traced function as one kernel of XLA's: the whole computation, marked `xla_cpu_small_call`, is emitted as a single
function. All that it contains must then be plain arithmetic, so the jaxpr is looked at first.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jaxtyping import Array

from .jaxprs.walk import equations
from .subroutine import subroutine
from .types import Equation


# What XLA:CPU cannot emit inside a single function: library calls, host callbacks, collectives, sorts. What lineax's
# `linear_solve` does, and checks, shows only when it is compiled.
_REFUSED = frozenset(
    "all_gather all_to_all approx_top_k cholesky conv_general_dilated custom_call debug_callback eig eigh ffi_call "
    "fft geqrf hessenberg householder_product infeed io_callback linear_map linear_solve lu one_kernel ormqr outfeed ppermute psum "
    "pure_callback qr random_gamma schur sort svd threefry2x32 top_k triangular_solve tridiagonal tridiagonal_solve".split()
)
_REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or".split())
# More equations than these take XLA longer as one kernel than as many, and the longer the more: 2,534: 1.8 s and 3.1 s; 4,672:
# 2.5 s and 3.9 s; 8,428: 7.7 s and 7.4 s.
LIMIT = 8000
SMALL_DOT = 64
LARGE_REDUCTION = 4096


def unsupported(jaxpr: ClosedJaxpr | Jaxpr) -> tuple[str, ...]:
    """The names of the primitives in `jaxpr`, at any depth, that keep it from being one kernel; empty if none does."""
    found = [eqn.primitive.name if _is_unsupported(eqn) else "" for eqn in equations(jaxpr)]
    return tuple(dict.fromkeys([name for name in found if name] or ["size"] * (len(found) > LIMIT)))


def _is_unsupported(eqn: Equation) -> bool:
    name = eqn.primitive.name
    if eqn.effects:
        return True
    if name.startswith("scatter"):
        # A single window is a dynamic update; several, as under `vmap`, are a loop that cannot be emitted.
        return math.prod(eqn.invars[1].aval.shape[:-1]) > 1
    if name in _REDUCTIONS:
        # XLA may hand the reduction of a large matrix to a library.
        return eqn.invars[0].aval.size > LARGE_REDUCTION and eqn.outvars[0].aval.size > 1
    if name == "dot_general":
        # XLA writes out a small product; a larger one is a library call.
        (contracted, _), _ = eqn.params["dimension_numbers"]
        shape = eqn.invars[0].aval.shape
        return eqn.outvars[0].aval.size * math.prod(shape[i] for i in contracted) > SMALL_DOT
    return name in _REFUSED


def qualifies(jaxpr: ClosedJaxpr, batched: bool = False) -> bool:
    """Whether XLA can make one kernel of it."""
    # Of the scatters only the update of one row becomes a copy, and that for certain only where nothing is batched.
    return not unsupported(jaxpr) and not (
        batched and any(eqn.primitive.name.startswith("scatter") for eqn in equations(jaxpr))
    )


def compiled(jaxpr: ClosedJaxpr, batched: bool = False) -> Callable[..., list[Any]]:
    """The function as one kernel where it can be one, else as XLA compiles it."""
    if not qualifies(jaxpr, batched):
        return jax.jit(jaxpr_as_fun(jaxpr))

    def call(*args: Array) -> list[Any]:
        # The kernel has nothing but a call in it: XLA aborts where one of its parameters is not the operand of anything.
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(lambda *xs: subroutine(jaxpr_as_fun(jaxpr))(*xs))(*args)

    return call
