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
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from .gathers import gathered
from .numbers import on_numbers


# Above this many scalar operations straight-line code costs more to compile than it saves at run time.
LIMIT = 500

_ELEMENTWISE = frozenset(
    "abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type cos cosh digamma div eq "
    "erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p logistic lt max min mul ne "
    "neg nextafter not or pow rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor".split()
)
_STRUCTURAL = frozenset(
    "add_any broadcast_in_dim concatenate copy copy_p dot_general dynamic_slice expand_dims gather iota pad reduce_max "
    "reduce_sum reshape rev slice split squeeze stack stop_gradient transpose".split()
)
_CALLS = {
    "closed_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}


# They have a derivative of their own, which their arithmetic has not: they are called as they are, on arrays.
_OPAQUE = frozenset({"custom_jvp_call", "custom_vjp_call"})


class _NotScalar(Exception):
    """The function has a primitive without a scalar form, or is too large."""


def scalarise(fn: Callable[..., Any], limit: int = LIMIT) -> Callable[..., Any]:
    """`fn` as straight-line scalar arithmetic, or `fn` itself where that is not possible or would be too large.

    `fn` maps pytrees of arrays to a pytree of arrays. Derivatives are those of the scalar arithmetic and are exact;
    what has a custom derivative keeps it.
    A product with a structural zero is 0, also where the other factor is not finite.
    """

    @functools.wraps(fn)
    def scalarised(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)

        def flat(*flat_leaves: Any) -> Any:
            return fn(*jax.tree.unflatten(treedef, flat_leaves))

        jaxpr, out = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        shapes, out_tree = jax.tree.flatten(out)

        def as_scalars(*flat_leaves: Any) -> list[jax.Array]:
            outputs = _Interpreter(limit).run(jaxpr, [_scalars(leaf) for leaf in flat_leaves])
            return [_array(o, s) for o, s in zip(outputs, shapes, strict=True)]

        try:
            # In a trace of its own, so that an attempt that is given up leaves nothing behind.
            rewritten = jax.make_jaxpr(as_scalars)(*leaves)
        except _NotScalar:
            return fn(*args)
        return jax.tree.unflatten(out_tree, jaxpr_as_fun(rewritten)(*leaves))

    return scalarised


def _scalars(x: Any) -> np.ndarray:
    """An array as a numpy array of scalars."""
    shape = np.shape(x)
    if isinstance(x, np.ndarray | np.generic | float | int | bool):
        x = np.asarray(x)
        entries: list[Any] = [x[i] for i in np.ndindex(shape)]
    else:
        flat = jnp.ravel(x)
        entries = [flat[i] for i in range(flat.size)] if shape else [x]
    return _object(entries, shape)


def _object(entries: Any, shape: tuple[int, ...]) -> np.ndarray:
    out = np.empty(len(entries), dtype=object)
    for i, entry in enumerate(entries):  # `out[:] = entries` would ask traced entries for their values
        out[i] = entry
    return out.reshape(shape)


def _array(scalars: np.ndarray, struct: Any) -> jax.Array:
    entries = [jnp.asarray(s, struct.dtype) for s in scalars.ravel()]
    if not struct.shape:
        return entries[0]
    if not entries:
        return jnp.zeros(struct.shape, struct.dtype)
    return jnp.stack(entries).reshape(struct.shape)


def _known(x: Any) -> bool:
    return isinstance(x, np.generic)


def _is(x: Any, value: float) -> bool:
    return isinstance(x, np.generic) and x == value


class _Interpreter:
    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.operations = 0

    def run(self, closed: ClosedJaxpr, args: list[np.ndarray]) -> list[np.ndarray]:
        jaxpr = closed.jaxpr
        env: dict[Any, np.ndarray] = dict(zip(jaxpr.invars, args, strict=True))
        env.update(zip(jaxpr.constvars, map(_constant, closed.consts), strict=True))

        def read(v: Any) -> np.ndarray:
            return _constant(np.asarray(v.val, v.aval.dtype)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            values = self.equation(eqn, [read(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, values, strict=True))
            if self.operations > self.limit:
                raise _NotScalar
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        name, params = eqn.primitive.name, eqn.params
        sizes = [v.aval.size for v in eqn.outvars]
        if name == "dot_general":
            sizes.append(sizes[0] * int(np.prod([args[0].shape[i] for i in eqn.params["dimension_numbers"][0][0]])))
        if max(sizes, default=0) > self.limit:
            raise _NotScalar
        if name in _CALLS:
            inner = params[_CALLS[name]]
            if not isinstance(inner, ClosedJaxpr):
                inner = ClosedJaxpr(inner, ())
            return self.run(inner, args)
        if name in _OPAQUE:
            return self.opaque(eqn, args)
        if name in _ELEMENTWISE:
            return [self.elementwise(eqn, args)]
        if name not in _STRUCTURAL:
            raise _NotScalar
        out = getattr(self, name)(eqn, args)
        return out if isinstance(out, list) else [out]

    def opaque(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        arrays = [_array(a, v.aval) for a, v in zip(args, eqn.invars, strict=True)]
        return list(map(_scalars, eqn.primitive.bind(*arrays, **eqn.primitive.get_bind_params(eqn.params))))

    def elementwise(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        shape = eqn.outvars[0].aval.shape
        operands = [np.broadcast_to(a, shape).ravel() for a in args]
        size = operands[0].size if operands else 0
        return _object([self.scalar(eqn, [o[i] for o in operands]) for i in range(size)], shape)

    def scalar(self, eqn: Any, x: list[Any]) -> Any:
        name = eqn.primitive.name
        if all(map(_known, x)) and eqn.outvars[0].aval.dtype in (bool, np.float64, np.float32):
            number = on_numbers(eqn, x)
            if number is not None:
                return number[()]
        if name == "mul":
            return self.product(*x)
        if name == "add":
            return self.total(*x)
        if name == "sub":
            if _is(x[1], 0):
                return x[0]
            return self.negative(x[1]) if _is(x[0], 0) else self.apply(eqn, x)
        if name == "neg":
            return self.negative(x[0])
        if name == "select_n" and _known(x[0]):
            return x[1 + int(x[0])]
        if name == "convert_element_type" and _known(x[0]):
            return np.asarray(x[0]).astype(eqn.params["new_dtype"])[()]
        if name == "div" and _known(x[0]) and x[0] == 0:
            return x[0]
        if name == "integer_pow" and eqn.params["y"] == 1:
            return x[0]
        return self.apply(eqn, x)

    def apply(self, eqn: Any, x: list[Any]) -> Any:
        self.operations += 1
        avals = [v.aval for v in eqn.invars]
        params = eqn.params
        if eqn.primitive.name == "convert_element_type":
            params = dict(params, sharding=None)
        return eqn.primitive.bind(*(jnp.asarray(v, a.dtype) for v, a in zip(x, avals, strict=True)), **params)

    def product(self, a: Any, b: Any) -> Any:
        if _is(a, 0) or _is(b, 1):
            return a
        if _is(b, 0) or _is(a, 1):
            return b
        if _is(a, -1) or _is(b, -1):
            return self.negative(b if _is(a, -1) else a)
        self.operations += 1
        return a * b

    def total(self, a: Any, b: Any) -> Any:
        if _is(a, 0):
            return b
        if _is(b, 0):
            return a
        self.operations += 1
        return a + b

    def negative(self, a: Any) -> Any:
        if _is(a, 0):
            return a
        self.operations += 1
        return -a

    def reshape(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return args[0].reshape(eqn.outvars[0].aval.shape)

    squeeze = expand_dims = reshape

    def copy(self, _: Any, args: list[np.ndarray]) -> np.ndarray:
        return args[0]

    stop_gradient = copy_p = copy

    def broadcast_in_dim(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        shape, dimensions = eqn.params["shape"], eqn.params["broadcast_dimensions"]
        inner = [1] * len(shape)
        for size, dimension in zip(args[0].shape, dimensions, strict=True):
            inner[dimension] = size
        return np.broadcast_to(args[0].reshape(inner), shape)

    def transpose(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.transpose(args[0], eqn.params["permutation"])

    def rev(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.flip(args[0], eqn.params["dimensions"])

    def slice(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        p = eqn.params
        strides = p["strides"] or (1,) * args[0].ndim
        return args[0][tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]

    def split(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        return np.split(args[0], np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"])

    def add_any(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return _object(list(map(self.total, *(a.ravel() for a in args))), eqn.outvars[0].aval.shape)

    def stack(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.stack(args, axis=eqn.params["axis"])

    def concatenate(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.concatenate(args, axis=eqn.params["dimension"])

    def iota(self, eqn: Any, _: list[np.ndarray]) -> np.ndarray:
        shape, dimension = eqn.params["shape"], eqn.params["dimension"]
        along = np.arange(shape[dimension], dtype=eqn.params["dtype"])
        along = along.reshape([-1 if i == dimension else 1 for i in range(len(shape))])
        return _constant(np.broadcast_to(along, shape))

    def pad(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, fill = args
        config = eqn.params["padding_config"]
        if any(low < 0 or high < 0 for low, high, _ in config):
            raise _NotScalar
        out = np.empty(eqn.outvars[0].aval.shape, dtype=object)
        out[...] = fill[()]
        out[tuple(slice(low, out.shape[i] - high, gap + 1) for i, (low, high, gap) in enumerate(config))] = x
        return out

    def gather(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, indices = args
        if not all(_known(i) for i in indices.ravel()):
            raise _NotScalar
        p, places = eqn.params, np.arange(x.size).reshape(x.shape)
        moved = gathered(places, indices.astype(int), p["dimension_numbers"], p["slice_sizes"], p["mode"])
        if (moved < 0).any():
            raise _NotScalar
        return _object(x.ravel()[moved.ravel()], moved.shape)

    def dynamic_slice(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, starts = args[0], [a[()] for a in args[1:]]
        if not all(map(_known, starts)):
            raise _NotScalar
        sizes = eqn.params["slice_sizes"]
        first = [min(max(int(s), 0), d - k) for s, d, k in zip(starts, x.shape, sizes, strict=True)]
        return x[tuple(slice(s, s + k) for s, k in zip(first, sizes, strict=True))]

    def reduce_sum(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.total, 0)

    def reduce_max(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.larger, -np.inf)

    def larger(self, a: Any, b: Any) -> Any:
        if _known(a) and _known(b):
            return np.maximum(a, b)
        if _is(a, -np.inf):
            return b
        self.operations += 1
        return jax.lax.max(*(jnp.asarray(x, (b if _known(a) else a).dtype) for x in (a, b)))

    def reduced(self, eqn: Any, x: np.ndarray, combine: Callable[[Any, Any], Any], identity: float) -> np.ndarray:
        dtype = eqn.outvars[0].aval.dtype
        if identity and not jnp.issubdtype(dtype, jnp.floating):
            raise _NotScalar
        axes = eqn.params["axes"]
        x = np.moveaxis(x, axes, range(len(axes)))
        x = x.reshape((-1, *x.shape[len(axes) :]))
        first = np.asarray(identity, dtype)[()]
        return _object(
            [functools.reduce(combine, x[(slice(None), *i)], first) for i in np.ndindex(x.shape[1:])], x.shape[1:]
        )

    def dot_general(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        (lhs_contract, rhs_contract), (lhs_batch, rhs_batch) = eqn.params["dimension_numbers"]
        lhs, rhs = (
            _matrices(a, batch, contract)
            for a, batch, contract in zip(args, (lhs_batch, rhs_batch), (lhs_contract, rhs_contract), strict=True)
        )
        aval = eqn.outvars[0].aval
        zero = np.zeros((), aval.dtype)[()]
        out = [
            functools.reduce(self.total, (self.product(x, y) for x, y in zip(a, b, strict=True)), zero)
            for left, right in zip(lhs, rhs, strict=True)
            for a in left
            for b in right
        ]
        return _object(out, aval.shape)


def _matrices(x: np.ndarray, batch: tuple[int, ...], contract: tuple[int, ...]) -> np.ndarray:
    """`x` as (batch, free, contracted), each in row-major order."""
    free = [i for i in range(x.ndim) if i not in batch and i not in contract]
    count = [functools.reduce(operator.mul, (x.shape[i] for i in dims), 1) for dims in (batch, free, contract)]
    return np.transpose(x, (*batch, *free, *contract)).reshape(count)


def _constant(x: Any) -> np.ndarray:
    """A constant as known scalars, or as unknown ones where it is being traced."""
    if isinstance(x, jax.core.Tracer):
        return _scalars(x)
    x = np.asarray(x)
    return _object([x[i] for i in np.ndindex(x.shape)], x.shape)
