"""Functions as polynomials in whatever is not known while tracing: what of them cancels, whatever their arguments are.

Inputs, constants that are being traced and the results of functions such as exp are the unknowns; equal arguments make
equal results, so that C(v) here and C(v) there are one unknown. What comes out as the zero polynomial is zero for all
arguments. The converse does not hold: sin² + cos² − 1 is a polynomial in two unknowns.
"""

import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from ..types import Equation
from .objects import is_number, objects
from .scalar_interpreter import ScalarInterpreter, Unsupported


# Operations on polynomials, about 3 µs each.
LIMIT = 20_000
# A product of more terms than this is an unknown of its own.
TERMS = 64
# Higher powers also.
POWER = 4

# Coefficients of monomials; a monomial is a sorted tuple of unknowns.
Polynomial = dict[tuple[int, ...], float]
Entry = Polynomial | np.number


def polynomials(fn: Callable[..., Any], *args: PyTree) -> np.ndarray | None:
    """The numbers of `fn(*args)`, a single array, as an array of polynomials. `args` give shapes only.

    `None` where a primitive has no such form or there is too much to do.
    """
    leaves, treedef = jax.tree.flatten(args)
    jaxpr = jax.make_jaxpr(lambda *flat: fn(*jax.tree.unflatten(treedef, flat)))(*leaves)
    interpreter = _Polynomials(LIMIT)
    inputs = [interpreter.unknowns(("input", i), leaf.shape) for i, leaf in enumerate(leaves)]
    try:
        (out,) = interpreter.run(jaxpr, inputs)
    except Unsupported:
        return None
    return objects([_polynomial(x) for x in out.ravel()], out.shape)


def _polynomial(x: Entry) -> Polynomial:
    if is_number(x):
        return {(): float(x)} if x != 0 else {}
    return x


class _Polynomials(ScalarInterpreter[Entry]):
    """Each entry that is not known is a `Polynomial`."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit)
        self.known: dict[Hashable, int] = {}
        # Kept, so that none gets the address of one that has gone.
        self.constants: list[Array] = []

    def unknowns(self, name: Hashable, shape: tuple[int, ...]) -> np.ndarray:
        return objects([self.unknown((name, i)) for i in range(int(np.prod(shape)))], shape)

    def unknown(self, name: Hashable) -> Polynomial:
        """The unknown of this name, the same one for the same name."""
        return {(self.known.setdefault(name, len(self.known)),): 1.0}

    def traced(self, x: Array) -> np.ndarray:
        self.constants.append(x)
        return self.unknowns(("traced", id(x)), x.shape)

    def opaque(self, eqn: Equation, args: list[np.ndarray]) -> list[np.ndarray]:
        called = ("call", len(self.known))
        return [self.unknowns((called, i), v.aval.shape) for i, v in enumerate(eqn.outvars)]

    def apply(self, eqn: Equation, x: list[Entry]) -> Any:
        self.operations += 1
        name, params, dtype = eqn.primitive.name, eqn.params, eqn.outvars[0].aval.dtype
        if np.issubdtype(dtype, np.complexfloating):
            raise Unsupported("complex numbers are no polynomials")
        if not np.issubdtype(dtype, np.floating):
            return self.function(eqn, x)
        match name:
            case "sub":
                return self.total(x[0], self.negative(x[1]))
            case "div":
                return self.product(x[0], self.inverse(x[1]))
            case "square":
                return self.product(x[0], x[0])
            case "integer_pow" if 0 < params["y"] <= POWER:
                return functools.reduce(self.product, [x[0]] * params["y"])
            case "select_n" if all(_key(case) == _key(x[1]) for case in x[2:]):
                return x[1]
            case "convert_element_type" if np.issubdtype(eqn.invars[0].aval.dtype, np.floating):
                return x[0]
        return self.function(eqn, x)

    def function(self, eqn: Equation, x: list[Entry]) -> Polynomial:
        return self.unknown((eqn.primitive.name, str(eqn.params), *map(_key, x)))

    def inverse(self, a: Entry) -> Any:
        if is_number(a):
            return 1 / a
        if len(a) == 1:
            ((monomial, factor),) = a.items()
            return self.scaled(self.unknown(("inverse", monomial)), 1 / factor)
        return self.unknown(("inverse", _key(a)))

    def product(self, a: Entry, b: Entry) -> Any:
        self.operations += 1
        if is_number(a) and is_number(b):
            return a * b
        if is_number(a):
            return self.scaled(_polynomial(b), a)
        if is_number(b):
            return self.scaled(_polynomial(a), b)
        if len(a) * len(b) > TERMS:
            return self.unknown(("mul", *sorted((_key(a), _key(b)))))
        found: Any = {}
        for left, c in a.items():
            found = self.total(found, {tuple(sorted(left + right)): c * d for right, d in b.items()})
        return found

    def scaled(self, a: Polynomial, factor: np.generic | float) -> Any:
        return {monomial: float(factor) * c for monomial, c in a.items()} if factor != 0 else np.float64(0)

    def total(self, a: Entry, b: Entry) -> Any:
        self.operations += 1
        if is_number(a) and is_number(b):
            return a + b
        found = dict(_polynomial(a))
        for monomial, c in _polynomial(b).items():
            before = found.get(monomial, 0.0)
            found[monomial] = before + c
            # What is left of numbers that cancel is none.
            if abs(before + c) <= 1e-13 * max(abs(before), abs(c)):
                del found[monomial]
        return found

    def negative(self, a: Entry) -> Any:
        return -a if is_number(a) else self.scaled(a, -1)

    def larger(self, a: Entry, b: Entry) -> Any:
        return self.unknown(("max", *sorted((_key(a), _key(b)))))


def _key(x: Entry) -> tuple[Any, ...]:
    return tuple(sorted(_polynomial(x).items()))
