"""What may be asked of each primitive: arguments at the edges of what it takes, and how near the answers must come.

A recipe gives, for a primitive and a type of numbers, an operation of random shapes and parameters.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax._src import ad_util

from .numbers import ALL, BOOL, COMPLEX, FLOATS, INTEGERS, REAL, SIGNED, Draw, Operand


@dataclasses.dataclass(frozen=True)
class Operation:
    """`ulps`: how many units in the last place its results may be off, 0: they are the same; `smooth`: it has a derivative
    in the domain "smooth".
    """

    name: str
    fn: Callable[..., Any]
    operands: tuple[Operand, ...]
    ulps: float = 0
    smooth: bool = False


Recipe = Callable[[str, str, Draw], Operation]
RECIPES: dict[tuple[str, str], Recipe] = {}


def recipe(names: str, dtypes: Sequence[str]) -> Callable[[Recipe], Recipe]:
    def known(make: Recipe) -> Recipe:
        RECIPES.update({(name, dtype): make for name in names.split() for dtype in dtypes})
        return make

    return known


# How far two ways to compute a function may be apart, in units in the last place: of the C library's and of XLA's own.
# XLA's exp2 of one number is exp(x ln 2), off by x/2 units; its atanh is off by 72 units, its cbrt of the least number by 60.
ULPS = {
    "acos": 4, "acosh": 32, "asin": 4, "asinh": 32, "atan": 4, "atan2": 8, "atanh": 128, "cbrt": 128, "cos": 8, "cosh": 16, "erf": 16,
    "erfc": 64, "exp": 8, "exp2": 512, "expm1": 16, "log": 8, "log1p": 16, "logistic": 16, "pow": 64, "rsqrt": 4, "sin": 8, "sinh": 16,
    "tan": 16, "tanh": 16, "digamma": 256, "erf_inv": 64, "lgamma": 256,
}  # fmt: skip


@recipe(" ".join(ULPS.keys() - {"atan2", "pow"}), FLOATS)
def of_library(name: str, dtype: str, draw: Draw) -> Operation:
    # XLA's gamma functions are right to units of 1, not of their own size, next to their zeros.
    domain = "smooth" if name in ("lgamma", "digamma") else "edges"
    x = Operand(dtype, draw.shape(), domain)
    return Operation(name, getattr(lax, name), (x,), ULPS[name], name not in ("acosh", "digamma"))


@recipe("atan2 nextafter", FLOATS)
def of_two(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return Operation(name, getattr(lax, name), (x, x), ULPS.get(name, 0), name == "atan2")


@recipe("pow", FLOATS)
def power(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    y = x._replace(dtype=draw.one_of(["int32", "int8"])) if draw.chance(0.3) else x
    if draw.chance(0.4):
        number = np.dtype(dtype).type(draw.one_of([0.5, 0.25, 0.125, -0.5, 2.0, 3.0, 0.0, -1.0, 1.5, 2.5]))
        return Operation(name, lambda a: lax.pow(a, number), (x,), ULPS["pow"], True)
    return Operation(name, lax.pow, (x, y), ULPS["pow"], y.dtype == dtype)


@recipe("ceil floor is_finite", FLOATS)
@recipe("sqrt", FLOATS)
@recipe("neg", (*FLOATS, *INTEGERS))
@recipe("abs", (*FLOATS, *SIGNED))
@recipe("square", (*FLOATS, *INTEGERS))
@recipe("sign", (*FLOATS, *INTEGERS))
@recipe("not", (*INTEGERS, *BOOL))
@recipe("population_count clz", INTEGERS)
@recipe("neg conj real imag", COMPLEX)
def exactly(name: str, dtype: str, draw: Draw) -> Operation:
    fn = lax.bitwise_not if name == "not" else getattr(lax, name)
    smooth = name in ("sqrt", "abs", "neg", "square") and dtype in FLOATS
    return Operation(name, fn, (Operand(dtype, draw.shape()),), 0, smooth)


@recipe("abs square", COMPLEX)
def of_complex(name: str, dtype: str, draw: Draw) -> Operation:
    return Operation(name, getattr(lax, name), (Operand(dtype, draw.shape(), "plain"),), 4, name == "abs")


@recipe("copy stop_gradient", ALL)
def same(name: str, dtype: str, draw: Draw) -> Operation:
    fn = jnp.copy if name == "copy" else lax.stop_gradient
    return Operation(name, fn, (Operand(dtype, draw.shape()),))


def _turned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.flip(y), np.flip(x)


_turned.never_raises = True


@recipe("pure_callback", ALL)
def on_host(name: str, dtype: str, draw: Draw) -> Operation:
    x, y = Operand(dtype, draw.shape()), Operand(dtype, draw.shape())
    found = tuple(jax.ShapeDtypeStruct(of.shape, np.dtype(dtype)) for of in (y, x))
    turned = lambda a, b: jax.pure_callback(_turned, found, a, b, vmap_method="sequential")
    which = draw.below(2)
    return Operation(name, lambda a, b: turned(a, b)[which], (x, y))


@recipe("round", FLOATS)
def rounding(name: str, dtype: str, draw: Draw) -> Operation:
    method = lax.RoundingMethod(draw.below(2))
    return Operation(name, lambda x: lax.round(x, method), (Operand(dtype, draw.shape()),))


@recipe("integer_pow", (*FLOATS, *INTEGERS, *COMPLEX))
def whole_power(name: str, dtype: str, draw: Draw) -> Operation:
    y = draw.below(6) if dtype not in FLOATS else draw.below(9) - 3
    if dtype in COMPLEX:
        y = max(y, 1)
    x = Operand(dtype, draw.shape(), "edges" if dtype in REAL else "plain")
    return Operation(name, lambda a: lax.integer_pow(a, y), (x,), 0 if dtype in INTEGERS else 8, dtype in FLOATS)


@recipe("add sub mul", (*FLOATS, *INTEGERS, *COMPLEX))
@recipe("div", (*FLOATS, *INTEGERS, *COMPLEX))
@recipe("rem", (*FLOATS, *INTEGERS))
@recipe("max min", REAL)
@recipe("add_any", ALL)
def of_pair(name: str, dtype: str, draw: Draw) -> Operation:
    of_complex = dtype in COMPLEX and name in ("mul", "div")
    x = Operand(
        dtype, draw.shape(), "smooth" if name == "div" and dtype in COMPLEX else "plain" if of_complex else "edges"
    )
    fn = ad_util.add_any_p.bind if name == "add_any" else getattr(lax, name)
    smooth = dtype in FLOATS and name in ("add", "sub", "mul", "div", "rem")
    # XLA multiplies by the reciprocal of a known divisor.
    ulps = 16 if of_complex else int(name == "div" and dtype in FLOATS)
    return _with_number(Operation(name, fn, (x, x), ulps, smooth), draw)


@recipe("and or xor", (*INTEGERS, *BOOL))
def bitwise(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return _with_number(Operation(name, getattr(lax, f"bitwise_{name}"), (x, x)), draw)


@recipe("lt le gt ge", REAL)
@recipe("eq ne", ALL)
def comparison(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return _with_number(Operation(name, getattr(lax, name), (x, x)), draw)


@recipe("shift_left shift_right_logical shift_right_arithmetic", INTEGERS)
def shift(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return _with_number(Operation(name, getattr(lax, name), (x, x._replace(domain="shifts"))), draw)


def _with_number(operation: Operation, draw: Draw) -> Operation:
    """At times one operand is known, one number or an array of them, or both are the same."""
    a, b = operation.operands
    if draw.chance(0.75) or operation.name == "add_any":
        return operation
    fn, how = operation.fn, draw.below(4)
    if how == 3 and b.domain == a.domain:
        return dataclasses.replace(operation, fn=lambda x: fn(x, x), operands=(a,))
    known = draw.numbers(b._replace(shape=() if how else b.shape))[()]
    if how == 1 and b.domain == a.domain:
        return dataclasses.replace(operation, fn=lambda x: fn(known, x), operands=(a,))
    return dataclasses.replace(operation, fn=lambda x: fn(x, known), operands=(a,))


@recipe("clamp", (*FLOATS, *INTEGERS))
def limited(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    limit = x._replace(shape=() if draw.chance(0.5) else x.shape)
    return Operation(name, lax.clamp, (limit, x, limit))


@recipe("select_n", ALL)
def choice(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    count = 2 if draw.chance(0.6) else 1 + draw.below(4)
    shape = x.shape if draw.chance(0.7) else ()
    if count == 2:
        return Operation(name, lax.select_n, (Operand("bool", shape), x, x))
    which = Operand("int32", shape, "smooth")  # what is out of range XLA leaves open
    inside = lambda i, *xs: lax.select_n(lax.rem(lax.abs(i) & 7, np.int32(count)), *xs)
    return Operation(name, inside, (which, *[x] * count))


@recipe("convert_element_type", ALL)
def conversion(name: str, dtype: str, draw: Draw) -> Operation:
    to = draw.one_of([d for d in ALL if dtype not in COMPLEX or d in COMPLEX])
    return Operation(name, lambda x: lax.convert_element_type(x, to), (Operand(dtype, draw.shape()),))


@recipe("complex", FLOATS)
def from_parts(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return Operation(name, lax.complex, (x, x))


@recipe("iota", (*FLOATS, *INTEGERS, *COMPLEX))
def counting(name: str, dtype: str, draw: Draw) -> Operation:
    shape = draw.shape(1)
    axis = draw.below(len(shape))
    x = Operand(dtype, shape, "plain")
    return Operation(name, lambda a: a + lax.broadcasted_iota(dtype, shape, axis), (x,))


@recipe("eq_to le_to lt_to", (*FLOATS, *INTEGERS))
def total_order(name: str, dtype: str, draw: Draw) -> Operation:
    x = Operand(dtype, draw.shape())
    return Operation(name, getattr(lax, f"{name}_p").bind, (x, x))


@recipe("bitcast_convert_type", (*FLOATS, *INTEGERS))
def same_bits(name: str, dtype: str, draw: Draw) -> Operation:
    bits = 8 * np.dtype(dtype).itemsize
    to = draw.one_of([d for d in (*FLOATS, *INTEGERS) if 8 * np.dtype(d).itemsize == bits])
    # Bits of integers may be those of numbers that are flushed to 0.
    to = to if dtype in FLOATS else to if to in INTEGERS else dtype
    return Operation(name, lambda x: lax.bitcast_convert_type(x, to), (Operand(dtype, draw.shape()),))


@recipe("reduce_precision", FLOATS)
def less_precise(name: str, dtype: str, draw: Draw) -> Operation:
    exponent, mantissa = draw.one_of([(5, 10), (8, 7), (8, 23), (11, 52), (4, 3)])
    return Operation(name, lambda x: lax.reduce_precision(x, exponent, mantissa), (Operand(dtype, draw.shape()),))
