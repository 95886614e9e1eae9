"""Primitives that are written with simpler ones: a table from a primitive's name to a function of its operands.

A function gets the operands and the parameters of the equation, and gives the results, as `jax.numpy` and `jax.lax` compute
them. It raises `Unsupported` for what it does not take.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from ..._compat import low
from ...types import DType, Equation
from ..special_functions import by_simpler_ones
from ..substitution import Substitution
from ..unchecked import checks_dropped
from .factorisations import cholesky, is_by_lapack, lu, lu_pivots_to_permutation
from .orthogonal import geqrf, householder_product, qr
from .sorting import sort
from .triangular import triangular_solve


def _platform_index(*, platforms: Sequence[Sequence[str] | None], **_: object) -> np.int32:
    """Which of several implementations is for the CPU."""
    return np.int32(next(i for i, names in enumerate(platforms) if names is None or "cpu" in names))


def _empty(*, dtype: DType, **_: object) -> Any:
    return jnp.zeros((), dtype)


def kernel_written_out(*args: Array, jaxpr: ClosedJaxpr, batched: tuple[bool, ...], **_: object) -> list[Any]:
    """What a kernel computes, as the equations that it was made from; within another kernel it is a part of that."""
    fn: Callable[..., list[Any]] = jaxpr_as_fun(jaxpr)
    return jax.vmap(fn, in_axes=[0 if b else None for b in batched])(*args) if batched else fn(*args)


EXPANSIONS: dict[str, Callable[..., Any]] = {
    "cholesky": cholesky,
    "empty2": _empty,
    "geqrf": geqrf,
    "householder_product": householder_product,
    "lu": lu,
    "lu_pivots_to_permutation": lu_pivots_to_permutation,
    # equinox's mark of what is not to be transformed any more; what is written out may be.
    "nontraceable": lambda x, **_: x,
    "platform_index": _platform_index,
    "qr": qr,
    "sort": sort,
    "triangular_solve": triangular_solve,
}
# lineax's, and derivatives of kernels: what they do shows where they are evaluated.
_EVALUATED = frozenset({"linear_solve", "linear_map"})


def expanded(closed: ClosedJaxpr, checks: bool = True) -> ClosedJaxpr:
    """The same function without the primitives of the table, at any depth; without `checks`, those that come to light are left
    out: what is singular then gives what is not finite.
    """

    def simpler(eqn: Equation) -> ClosedJaxpr | None:
        name = eqn.primitive.name
        if is_by_lapack(eqn):
            return None
        if name in EXPANSIONS:
            return by_simpler_ones(eqn, EXPANSIONS)
        if name == "one_kernel" and not eqn.params["batched"]:
            return eqn.params["jaxpr"]
        if name != "one_kernel" and name not in _EVALUATED:
            return None
        fn = functools.partial(kernel_written_out if name == "one_kernel" else eqn.primitive.impl, **eqn.params)
        inner = jax.make_jaxpr(fn)(*(v.aval for v in eqn.invars))
        return inner if checks else checks_dropped(inner)

    return Substitution(simpler)(low(closed))
