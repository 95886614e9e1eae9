"""Arithmetic on numbers that are known while tracing, by numpy: JAX would compile a program for each shape."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from ..types import DType, Equation


_EXACT = {
    "abs": np.abs, "add": np.add, "and": np.bitwise_and, "copy": np.asarray, "eq": np.equal, "ge": np.greater_equal,
    "gt": np.greater, "le": np.less_equal, "lt": np.less, "max": np.maximum, "min": np.minimum, "mul": np.multiply,
    "ne": np.not_equal, "neg": np.negative, "not": np.invert, "or": np.bitwise_or, "sub": np.subtract,
}  # fmt: skip


@functools.partial(np.vectorize, otypes=[float])
def _lgamma(x: float) -> float:
    return math.lgamma(x) if x > 0 or x % 1 else math.inf


# Taylor arithmetic makes factorials of the last two, which are right to round-off.
_OF_FLOATS = {"div": np.divide, "exp": np.exp, "lgamma": _lgamma}


def converted(x: ArrayLike, dtype: DType) -> Any:
    """Numbers as ones of another type, as XLA has it: into integers to the nearest there is, what is undefined to 0."""
    x, dtype = np.asarray(x), np.dtype(dtype)
    x = np.real(x) if dtype.kind != "c" else x
    with np.errstate(all="ignore"):
        if x.dtype.kind != "f" or dtype.kind not in "iu":
            return x.astype(dtype)[()]
        info = np.iinfo(dtype)
        # The largest integer may be no float: then the float above it is the first that is too large.
        inside = (x > info.min) & (x < float(info.max))
        limits = np.where(x > 0, info.max, np.where(np.isnan(x), 0, info.min)).astype(dtype)
        return np.where(inside, np.where(inside, x, 0).astype(dtype), limits)[()]


def on_numbers(eqn: Equation, values: Sequence[np.ndarray]) -> np.ndarray | None:
    """What an equation of a jaxpr with one output gives for numbers; `None` where numpy may see that differently."""
    function = _of_numbers(eqn)
    if function is None:
        return None
    with np.errstate(all="ignore"):
        return np.asarray(function(*values), eqn.outvars[0].aval.dtype)


def is_on_numbers(eqn: Equation) -> bool:
    """Whether `on_numbers` gives something."""
    return _of_numbers(eqn) is not None


def _of_numbers(eqn: Equation) -> Any:
    name = eqn.primitive.name
    if name == "convert_element_type":
        return lambda x: converted(x, eqn.params["new_dtype"])
    if name == "select_n" and len(eqn.invars) == 3 and eqn.invars[0].aval.dtype == bool:
        return lambda which, first, second: np.where(which, second, first)
    if name in _OF_FLOATS and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return _OF_FLOATS[name]
    return _EXACT.get(name)
