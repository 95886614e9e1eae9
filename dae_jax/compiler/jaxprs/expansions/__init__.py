"""Primitives that are written with simpler ones: a table from a primitive's name to a function of its operands.

A function gets the operands and the parameters of the equation, and gives the results, as `jax.numpy` and `jax.lax` compute
them. It raises `Unsupported` for what it does not take.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from ...types import Arrays, DType, Equation
from ..rewriting import Rewriting
from ..unchecked import checks_dropped
from ..walk import equations
from .factorisations import cholesky, lu, lu_pivots_to_permutation
from .orthogonal import geqrf, householder_product, qr
from .sorting import sort
from .triangular import triangular_solve


def _platform_index(*, platforms: Sequence[Sequence[str] | None], **_: object) -> np.int32:
    """Which of several implementations is for the CPU."""
    return np.int32(next(i for i, names in enumerate(platforms) if names is None or "cpu" in names))


def _empty(*, dtype: DType, **_: object) -> Any:
    return jnp.zeros((), dtype)


def kernel_written_out(*args: Array, jaxpr: ClosedJaxpr, lanes: tuple[bool, ...]) -> list[Any]:
    """What a kernel computes, as the equations that it was made from; within another kernel it is a part of that."""
    fn: Callable[..., list[Any]] = jaxpr_as_fun(jaxpr)
    return jax.vmap(fn, in_axes=[0 if b else None for b in lanes])(*args) if lanes else fn(*args)


EXPANSIONS: dict[str, Callable[..., Any]] = {
    "cholesky": cholesky,
    "empty2": _empty,
    "geqrf": geqrf,
    "householder_product": householder_product,
    "lu": lu,
    "lu_pivots_to_permutation": lu_pivots_to_permutation,
    # equinox's mark of what is not to be transformed any more; what is written out may be.
    "nontraceable": lambda x, **_: x,
    "one_kernel": kernel_written_out,
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
    if not any(map(_is_expanded, equations(closed))):
        return closed

    def fn(*args: Array) -> list[Any]:
        return rewriting.run(closed.jaxpr, closed.consts, args, [])[0]

    rewriting = Rewriting(_is_expanded, lambda eqn, args, state: (_results(eqn, args, checks), state))
    return jax.make_jaxpr(fn)(*closed.in_avals)


def _is_expanded(eqn: Equation) -> bool:
    return eqn.primitive.name in EXPANSIONS or eqn.primitive.name in _EVALUATED


def _results(eqn: Equation, args: Arrays, checks: bool) -> list[Any]:
    name, params = eqn.primitive.name, eqn.primitive.get_bind_params(eqn.params)
    if name in EXPANSIONS:
        out = EXPANSIONS[name](*args, **params)
        return list(out) if eqn.primitive.multiple_results else [out]
    inner = jax.make_jaxpr(lambda *xs: eqn.primitive.impl(*xs, **params))(*args)
    inner = expanded(inner if checks else checks_dropped(inner), checks)
    return eval_jaxpr(inner.jaxpr, inner.consts, *args)
