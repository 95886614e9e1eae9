"""Functions interpreted entry by entry: what arrays do is data movement, what is left is arithmetic on single entries.

`ScalarInterpreter` runs a jaxpr with every array as a numpy array of objects. What an object is (a traced scalar, a
polynomial) and what arithmetic on it means is up to its subclasses.
"""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from .gathers import gathered, scattered
from .numbers import converted, on_numbers


ELEMENTWISE = frozenset(
    "abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type cos cosh digamma div eq "
    "erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p logistic lt max min mul ne "
    "neg nextafter not or pow rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor".split()
)
STRUCTURAL = frozenset(
    "add_any broadcast_in_dim concatenate copy copy_p dot_general dynamic_slice expand_dims gather iota pad reduce_max "
    "reduce_sum reshape rev slice split squeeze stack stop_gradient tile transpose".split()
)
_SCATTERS = {"scatter": None, "scatter-add": "total"}
CALLS = {
    "closed_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}
# They have a derivative of their own, which their arithmetic has not.
_OPAQUE = frozenset({"custom_jvp_call", "custom_vjp_call"})


class Unsupported(Exception):
    """The function has a primitive without such a form, or is too large."""


def objects(entries: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A list as an array of objects."""
    out = np.empty(len(entries), dtype=object)
    for i, entry in enumerate(entries):  # `out[:] = entries` would ask traced entries for their values
        out[i] = entry
    return out.reshape(shape)


def is_number(x: Any, *which: float) -> bool:
    """Whether an entry is known while tracing, and one of `which` where these are given."""
    return isinstance(x, np.generic) and (not which or any(x == value for value in which))


def columns(x: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """An array with these axes as its first one."""
    x = np.moveaxis(x, axes, range(len(axes)))
    return x.reshape((math.prod(x.shape[: len(axes)]), *x.shape[len(axes) :]))


def as_indices(x: np.ndarray) -> np.ndarray:
    """Known entries as integers of 64 bits; what is too large for one is the largest."""
    return np.array([min(int(i), np.iinfo(np.int64).max) for i in x.ravel()], np.int64).reshape(x.shape)


class ScalarInterpreter:
    """Runs jaxprs; gives up with `Unsupported` after more than `limit` operations.

    An entry that is known while tracing is a numpy scalar.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.operations = 0

    # What subclasses say of entries

    def traced(self, x: Any) -> np.ndarray:
        """The entries of a constant that is being traced."""
        raise NotImplementedError

    def opaque(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        """A function with a derivative of its own."""
        raise NotImplementedError

    def apply(self, eqn: Any, x: list[Any]) -> Any:
        """An elementwise primitive, no sum or product."""
        raise NotImplementedError

    def product(self, a: Any, b: Any) -> Any:
        raise NotImplementedError

    def total(self, a: Any, b: Any) -> Any:
        raise NotImplementedError

    def negative(self, a: Any) -> Any:
        raise NotImplementedError

    def larger(self, a: Any, b: Any) -> Any:
        raise NotImplementedError

    # Arithmetic

    def run(self, closed: ClosedJaxpr, args: list[np.ndarray]) -> list[np.ndarray]:
        jaxpr = closed.jaxpr
        env: dict[Any, np.ndarray] = dict(zip(jaxpr.invars, args, strict=True))
        env.update(zip(jaxpr.constvars, map(self.constant, closed.consts), strict=True))

        def read(v: Any) -> np.ndarray:
            return self.constant(np.asarray(v.val, v.aval.dtype)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            values = self.equation(eqn, [read(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, values, strict=True))
            if self.operations > self.limit:
                raise Unsupported
        return [read(v) for v in jaxpr.outvars]

    def constant(self, x: Any) -> np.ndarray:
        """A constant as known numbers, or as unknown ones where it is being traced."""
        if isinstance(x, jax.core.Tracer):
            return self.traced(x)
        x = np.asarray(x)
        return objects([x[i] for i in np.ndindex(x.shape)], x.shape)

    def equation(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        name, params = eqn.primitive.name, eqn.params
        sizes = [v.aval.size for v in eqn.outvars]
        if name == "dot_general":
            sizes.append(sizes[0] * int(np.prod([args[0].shape[i] for i in eqn.params["dimension_numbers"][0][0]])))
        if max(sizes, default=0) > self.limit:
            raise Unsupported
        if name in CALLS:
            inner = params[CALLS[name]]
            if not isinstance(inner, ClosedJaxpr):
                inner = ClosedJaxpr(inner, ())
            return self.run(inner, args)
        if name in _OPAQUE:
            return self.opaque(eqn, args)
        if name in ELEMENTWISE:
            return [self.elementwise(eqn, args)]
        if name in _SCATTERS:
            return [self.scatter(eqn, args)]
        if name not in STRUCTURAL:
            raise Unsupported
        out = getattr(self, name)(eqn, args)
        return out if isinstance(out, list) else [out]

    def elementwise(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        shape = eqn.outvars[0].aval.shape
        operands = [np.broadcast_to(a, shape).ravel() for a in args]
        size = operands[0].size if operands else 0
        if all(is_number(x) for operand in operands for x in operand):
            numbers = on_numbers(
                eqn, [np.array(list(operand), v.aval.dtype) for operand, v in zip(operands, eqn.invars, strict=True)]
            )
            if numbers is not None:
                return objects(list(numbers), shape)
        return objects([self.scalar(eqn, [o[i] for o in operands]) for i in range(size)], shape)

    def scalar(self, eqn: Any, x: list[Any]) -> Any:
        name = eqn.primitive.name
        match name:
            case "mul":
                return self.product(*x)
            case "add":
                return self.total(*x)
            case "neg":
                return self.negative(x[0])
            case "sub" if is_number(x[1], 0):
                return x[0]
            case "sub" if is_number(x[0], 0):
                return self.negative(x[1])
            case "select_n" if is_number(x[0]):
                return x[1 + min(max(int(x[0]), 0), len(x) - 2)]
            case "convert_element_type" if is_number(x[0]):
                return converted(x[0], eqn.params["new_dtype"])
            case "div" if is_number(x[0], 0):
                return x[0]
            case "integer_pow" if eqn.params["y"] == 1:
                return x[0]
        return self.apply(eqn, x)

    def reduce_sum(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.total, 0)

    def reduce_max(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.larger, -np.inf)

    def reduced(self, eqn: Any, x: np.ndarray, combine: Callable[[Any, Any], Any], identity: float) -> np.ndarray:
        dtype = eqn.outvars[0].aval.dtype
        if identity and not jnp.issubdtype(dtype, jnp.floating):
            raise Unsupported
        x = columns(x, eqn.params["axes"])
        first = np.asarray(identity, dtype)[()]
        return objects(
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
        return objects(out, aval.shape)

    # Data movement

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

    def tile(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.tile(args[0], eqn.params["reps"])

    def rev(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.flip(args[0], eqn.params["dimensions"])

    def slice(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        p = eqn.params
        strides = p["strides"] or (1,) * args[0].ndim
        return args[0][tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]

    def split(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        return np.split(args[0], np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"])

    def add_any(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return objects(list(map(self.total, *(a.ravel() for a in args))), eqn.outvars[0].aval.shape)

    def stack(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.stack(args, axis=eqn.params["axis"])

    def concatenate(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        return np.concatenate(args, axis=eqn.params["dimension"])

    def iota(self, eqn: Any, _: list[np.ndarray]) -> np.ndarray:
        shape, dimension = eqn.params["shape"], eqn.params["dimension"]
        along = np.arange(shape[dimension]).astype(eqn.params["dtype"])
        along = along.reshape([-1 if i == dimension else 1 for i in range(len(shape))])
        return self.constant(np.broadcast_to(along, shape))

    def pad(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, fill = args
        config = eqn.params["padding_config"]
        if any(low < 0 or high < 0 for low, high, _ in config):
            raise Unsupported
        out = np.empty(eqn.outvars[0].aval.shape, dtype=object)
        out[...] = fill[()]
        out[tuple(slice(low, out.shape[i] - high, gap + 1) for i, (low, high, gap) in enumerate(config))] = x
        return out

    def gather(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, indices = args
        if not all(is_number(i) for i in indices.ravel()):
            raise Unsupported
        p, places = eqn.params, np.arange(x.size).reshape(x.shape)
        moved = gathered(places, as_indices(indices), p["dimension_numbers"], p["slice_sizes"], p["mode"])
        if (moved < 0).any():
            raise Unsupported
        return objects(x.ravel()[moved.ravel()], moved.shape)

    def dynamic_slice(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, starts = args[0], [a[()] for a in args[1:]]
        if not all(map(is_number, starts)):
            raise Unsupported
        sizes = eqn.params["slice_sizes"]
        first = [min(max(int(s), 0), d - k) for s, d, k in zip(starts, x.shape, sizes, strict=True)]
        return x[tuple(slice(s, s + k) for s, k in zip(first, sizes, strict=True))]

    def scatter(self, eqn: Any, args: list[np.ndarray]) -> np.ndarray:
        x, indices, updates = args
        if not all(map(is_number, indices.ravel())):
            raise Unsupported
        p, places = eqn.params, np.arange(x.size).reshape(x.shape)
        moved = scattered(places, as_indices(indices), updates.shape, p["dimension_numbers"], p["mode"])
        combine = _SCATTERS[eqn.primitive.name]
        out = x.ravel().copy()
        for place, update in zip(moved.ravel(), updates.ravel(), strict=True):
            if place >= 0:
                out[place] = getattr(self, combine)(out[place], update) if combine else update
        return out.reshape(x.shape)


def _matrices(x: np.ndarray, batch: tuple[int, ...], contract: tuple[int, ...]) -> np.ndarray:
    """`x` as (batch, free, contracted), each in row-major order."""
    free = [i for i in range(x.ndim) if i not in batch and i not in contract]
    count = [functools.reduce(operator.mul, (x.shape[i] for i in dims), 1) for dims in (batch, free, contract)]
    return np.transpose(x, (*batch, *free, *contract)).reshape(count)
