"""Functions interpreted entry by entry: what arrays do is data movement, what is left is arithmetic on single entries.

`ScalarInterpreter` runs a jaxpr with every array as a numpy array of objects. What an object is (a traced scalar, a
polynomial) and what arithmetic on it means is up to its subclasses.
"""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

from .._compat import is_key
from ..types import Atom, Equation, aval_of
from .movement import MOVEMENTS, dynamic_slice, gather, scatter
from .numbers import converted, on_numbers
from .objects import are_known, columns, is_number, objects
from .walk import CALLS, WITH_DERIVATIVE, called


ELEMENTWISE = frozenset(
    "abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type cos cosh digamma div eq "
    "erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma log log1p logistic lt max min mul ne "
    "neg nextafter not or pow rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
_AT_PLACES = frozenset({"dynamic_slice", "gather", "scatter", "scatter-add"})
_COMBINING = frozenset({"add_any", "dot_general", "reduce_max", "reduce_sum"})


class Unsupported(Exception):
    """Why a function cannot be written so: the reason in words, and where there is one the equation in short and its primitive."""

    def __init__(self, reason: str, equation: str = "", primitive: str = "") -> None:
        super().__init__(f"{reason}: {equation}" if equation else reason)
        self.reason, self.equation, self.primitive = reason, equation, primitive


# What an entry is.
E = TypeVar("E")


def _entries(eqn: Equation) -> int:
    """How many an equation has at most: those of a result, and the products that it is the sum of."""
    sizes = [v.aval.size for v in eqn.outvars]
    if eqn.primitive.name == "dot_general":
        contracted, _ = eqn.params["dimension_numbers"][0]
        sizes.append(sizes[0] * math.prod(aval_of(eqn.invars[0]).shape[i] for i in contracted))
    return max(sizes, default=0)


def refuse_large(closed: ClosedJaxpr, limit: int) -> None:
    """Raises `Unsupported` where an equation has more entries than the `limit`, which is found in no time."""
    for eqn in closed.jaxpr.eqns:
        if _entries(eqn) > limit:
            raise Unsupported("too many entries")
        inner = called(eqn, CALLS)
        if inner is not None:
            refuse_large(inner, limit)


class ScalarInterpreter(Generic[E]):
    """Runs jaxprs; gives up with `Unsupported` after more than `limit` operations.

    An entry that is known while tracing is a numpy scalar.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.operations = 0

    # What subclasses say of entries

    def traced(self, x: Array) -> np.ndarray:
        """The entries of a constant that is being traced."""
        raise NotImplementedError

    def opaque(self, eqn: Equation, args: list[np.ndarray]) -> list[np.ndarray]:
        """A function with a derivative of its own."""
        raise NotImplementedError

    def apply(self, eqn: Equation, x: list[E]) -> Any:
        """An elementwise primitive, no sum or product."""
        raise NotImplementedError

    def product(self, a: E, b: E) -> Any:
        raise NotImplementedError

    def total(self, a: E, b: E) -> Any:
        raise NotImplementedError

    def negative(self, a: E) -> Any:
        raise NotImplementedError

    def larger(self, a: E, b: E) -> Any:
        raise NotImplementedError

    # Arithmetic

    def run(self, closed: ClosedJaxpr, args: list[np.ndarray]) -> list[np.ndarray]:
        jaxpr = closed.jaxpr
        env: dict[Any, np.ndarray] = dict(zip(jaxpr.invars, args, strict=True))
        env.update(zip(jaxpr.constvars, map(self.constant, closed.consts), strict=True))

        def read(v: Atom) -> np.ndarray:
            return self.constant(np.asarray(v.val, aval_of(v).dtype)) if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            values = self.equation(eqn, [read(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, values, strict=True))
            if self.operations > self.limit:
                raise Unsupported("too many operations")
        return [read(v) for v in jaxpr.outvars]

    def constant(self, x: Any) -> np.ndarray:
        """A constant as known numbers, or as unknown ones where it is being traced."""
        if isinstance(x, Tracer):
            if x.size > self.limit:
                raise Unsupported("too many entries")
            return self.traced(x)
        if is_key(x):
            raise Unsupported("keys are no entries")
        x = np.asarray(x)
        return objects([x[i] for i in np.ndindex(x.shape)], x.shape)

    def equation(self, eqn: Equation, args: list[np.ndarray]) -> list[np.ndarray]:
        name = eqn.primitive.name
        if _entries(eqn) > self.limit:
            raise Unsupported("too many entries")
        inner = called(eqn, CALLS)
        if inner is not None:
            return self.run(inner, args)
        if name in WITH_DERIVATIVE:  # which their arithmetic has not
            return self.opaque(eqn, args)
        if name in ELEMENTWISE:
            return [self.elementwise(eqn, args)]
        if name in MOVEMENTS:
            out = MOVEMENTS[name](eqn, *args)
        elif name in _AT_PLACES:
            out = self._at_places(eqn, args)
        elif name in _COMBINING:
            out = getattr(self, name)(eqn, args)
        else:
            raise Unsupported(f"`{name}` of entries is not known")
        return out if isinstance(out, list) else [out]

    def elementwise(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
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

    def scalar(self, eqn: Equation, x: list[E]) -> Any:
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
            case "stop_gradient" if is_number(x[0]):
                return x[0]
            case "div" if is_number(x[0], 0):
                return x[0]
            case "integer_pow" if eqn.params["y"] == 1:
                return x[0]
        return self.apply(eqn, x)

    def reduce_sum(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.total, 0)

    def reduce_max(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
        return self.reduced(eqn, args[0], self.larger, -np.inf)

    def reduced(self, eqn: Equation, x: np.ndarray, combine: Callable[[E, E], E], identity: float) -> np.ndarray:
        dtype = eqn.outvars[0].aval.dtype
        if identity and not jnp.issubdtype(dtype, jnp.floating):
            raise Unsupported("the maximum of numbers other than floats is not known")
        x = columns(x, eqn.params["axes"])
        first: Any = np.asarray(identity, dtype)[()]
        return objects(
            [functools.reduce(combine, x[(slice(None), *i)], first) for i in np.ndindex(x.shape[1:])], x.shape[1:]
        )

    def dot_general(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
        (lhs_contract, rhs_contract), (lhs_batch, rhs_batch) = eqn.params["dimension_numbers"]
        lhs, rhs = (
            _matrices(a, batch, contract)
            for a, batch, contract in zip(args, (lhs_batch, rhs_batch), (lhs_contract, rhs_contract), strict=True)
        )
        aval = eqn.outvars[0].aval
        zero: Any = np.zeros((), aval.dtype)[()]
        out = [
            functools.reduce(self.total, (self.product(x, y) for x, y in zip(a, b, strict=True)), zero)
            for left, right in zip(lhs, rhs, strict=True)
            for a in left
            for b in right
        ]
        return objects(out, aval.shape)

    def add_any(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
        return objects(list(map(self.total, *(a.ravel() for a in args))), eqn.outvars[0].aval.shape)

    def _at_places(self, eqn: Equation, args: list[np.ndarray]) -> np.ndarray:
        """What reads or writes at places, which must be known."""
        name = eqn.primitive.name
        if not all(map(are_known, args[1:2] if name != "dynamic_slice" else args[1:])):
            raise Unsupported(f"`{name}` at a place that is not known")
        if name == "dynamic_slice":
            return dynamic_slice(eqn, *args)
        if name == "gather":
            return gather(eqn, *args)
        if name == "scatter" and eqn.params["update_jaxpr"] is not None:
            raise Unsupported("entries replaced by a function of them are not known")
        combine: Callable[..., Any] = self.total if name == "scatter-add" else lambda _, update: update
        return scatter(eqn, *args, combine=combine)


def _matrices(x: np.ndarray, batch: tuple[int, ...], contract: tuple[int, ...]) -> np.ndarray:
    """`x` as (batch, free, contracted), each in row-major order."""
    free = [i for i in range(x.ndim) if i not in batch and i not in contract]
    count = [functools.reduce(operator.mul, (x.shape[i] for i in dims), 1) for dims in (batch, free, contract)]
    return np.transpose(x, (*batch, *free, *contract)).reshape(count)
