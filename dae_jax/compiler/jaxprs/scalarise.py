"""Small array functions rewritten as straight-line scalar arithmetic.

A Jacobian by `jax.jacfwd`, the products and the elimination that follow it are, for a mechanism of a few bodies, a few
hundred multiplications, many of them by a structural 0 or 1. As array operations each costs a loop over two or four
entries; as scalars they are a few dozen nanoseconds of straight-line code (measured on the double pendulum: 27 ns an
evaluation against 68 ns). `scalarise` interprets the function's jaxpr with every array entry as a scalar of its own and
leaves out what is 0 or 1 by construction.

Data movement (reshape, slice, transpose, gather with fixed indices, ...) happens while tracing and costs nothing at run
time.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from .._compat import low
from ..types import Aval, Equation
from .objects import is_number, objects
from .scalar_interpreter import ScalarInterpreter, Unsupported, refuse_large


# Above this many scalar operations straight-line code costs more to compile than it saves at run time.
LIMIT = 500

# Traced, or known.
Scalar = Array | np.number


def scalarise(fn: Callable[..., Any], limit: int = LIMIT) -> Callable[..., Any]:
    """`fn` as straight-line scalar arithmetic, or `fn` itself where that is not possible or would be too large.

    `fn` maps pytrees of arrays to a pytree of arrays. Derivatives are those of the scalar arithmetic and are exact;
    what has a custom derivative keeps it.
    A product with a structural zero is 0, also where the other factor is not finite.
    """

    @functools.wraps(fn)
    def scalarised(*args: PyTree) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        if sum(map(np.size, leaves)) > limit:
            return fn(*args)

        def flat(*flat_leaves: Array) -> Any:
            return fn(*jax.tree.unflatten(treedef, flat_leaves))

        found, out = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        arrays, (shapes, out_tree) = low(found), jax.tree.flatten(out)

        def as_scalars(*flat_leaves: Array) -> list[jax.Array]:
            outputs = _Scalars(limit).run(arrays, [_scalars(leaf) for leaf in flat_leaves])
            return [_array(o, s) for o, s in zip(outputs, shapes, strict=True)]

        try:
            refuse_large(arrays, limit)
            # In a trace of its own, so that an attempt that is given up leaves nothing behind.
            found = jax.make_jaxpr(as_scalars)(*leaves)
        except Unsupported:
            pass
        return jax.tree.unflatten(out_tree, jaxpr_as_fun(found)(*leaves))

    return scalarised


def _scalars(x: ArrayLike) -> np.ndarray:
    """An array as a numpy array of scalars."""
    shape = np.shape(x)
    if isinstance(x, np.ndarray | np.generic | float | int | bool):
        x = np.asarray(x)
        entries: list[Any] = [x[i] for i in np.ndindex(shape)]
    else:
        flat = jnp.ravel(x)
        entries = [flat[i] for i in range(flat.size)] if shape else [x]
    return objects(entries, shape)


def _array(scalars: np.ndarray, struct: Aval) -> jax.Array:
    entries = [jnp.asarray(s, struct.dtype) for s in scalars.ravel()]
    if not struct.shape:
        return entries[0]
    if not entries:
        return jnp.zeros(struct.shape, struct.dtype)
    return jnp.stack(entries).reshape(struct.shape)


class _Scalars(ScalarInterpreter[Scalar]):
    """Each entry that is not known is a traced scalar."""

    def traced(self, x: Array) -> np.ndarray:
        return _scalars(x)

    def opaque(self, eqn: Equation, args: list[np.ndarray]) -> list[np.ndarray]:
        arrays = [_array(a, v.aval) for a, v in zip(args, eqn.invars, strict=True)]
        return list(map(_scalars, eqn.primitive.bind(*arrays, **eqn.primitive.get_bind_params(eqn.params))))

    def apply(self, eqn: Equation, x: list[Scalar]) -> Any:
        self.operations += 1
        avals = [v.aval for v in eqn.invars]
        params = eqn.params
        if eqn.primitive.name == "convert_element_type":
            params = dict(params, sharding=None)
        return eqn.primitive.bind(*(jnp.asarray(v, a.dtype) for v, a in zip(x, avals, strict=True)), **params)

    def product(self, a: Scalar, b: Scalar) -> Any:
        if is_number(a, 0) or is_number(b, 1):
            return a
        if is_number(b, 0) or is_number(a, 1):
            return b
        if is_number(a, -1) or is_number(b, -1):
            return self.negative(b if is_number(a, -1) else a)
        self.operations += 1
        return a * b

    def total(self, a: Scalar, b: Scalar) -> Any:
        if is_number(a, 0):
            return b
        if is_number(b, 0):
            return a
        self.operations += 1
        return a + b

    def negative(self, a: Scalar) -> Any:
        if is_number(a, 0):
            return a
        self.operations += 1
        return -a

    def larger(self, a: Scalar, b: Scalar) -> Any:
        if is_number(a) and is_number(b):
            return np.maximum(a, b)
        if is_number(a, -np.inf):
            return b
        self.operations += 1
        return jax.lax.max(*(jnp.asarray(x, (b if is_number(a) else a).dtype) for x in (a, b)))
