"""Dependence rules of primitives that compute each entry from the entries at its place, or move entries about."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..compiler import on_numbers
from ..compiler.types import Equation
from .cells import Cells, broadcast, evaluate, unless
from .sets import Sets


_ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e bitcast_convert_type cbrt ceil
    clamp clz complex conj convert_element_type copy copy_p cos cosh digamma div eq eq_to erf erf_inv erfc exp exp2 expm1 floor ge gt igamma
    igamma_grad_a igammac imag integer_pow is_finite le le_to lgamma log log1p logistic lt lt_to max min mul mulhi ne
    neg nextafter not or polygamma population_count pow real reduce_precision regularized_incomplete_beta rem round
    rsqrt shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan tanh
    xor zeta
"""
ELEMENTWISE = frozenset(_ELEMENTWISE.split())

# What has derivative zero wherever it has one (whatever yields integers or truth values apart).
FLAT = frozenset(["ceil", "floor", "round", "sign", "stop_gradient"])


def elementwise(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Each entry depends on what the entries at its place depend on, unless these settle it.

    A product with a known 0 is 0, also where the other factor may be infinite.
    """
    aval = eqn.outvars[0].aval
    settled = broadcast(np.asarray(_settled(eqn, inputs)), aval.shape)
    known, dependence = inputs[0].known, inputs[0].dependence
    for cells in inputs[1:]:
        known, dependence = known & cells.known, sets.union(dependence, cells.dependence)
    known = known | settled
    if not known.any():
        return [Cells.unknown(dependence, aval)]
    return [Cells(unless(known, dependence), known, _values(eqn, inputs, settled))]


def _settled(eqn: Equation, inputs: list[Cells]) -> Any:
    """Where some operands fix the result whatever the others are."""
    match eqn.primitive.name:
        case "mul":
            return ~(inputs[0].nonzero & inputs[1].nonzero)
        case "and":
            return ~(inputs[0].nonzero & inputs[1].nonzero)
        case "or" if eqn.outvars[0].aval.dtype == bool:
            return (inputs[0].known & inputs[0].value) | (inputs[1].known & inputs[1].value)
        case "div":
            return ~inputs[0].nonzero & ~(inputs[1].known & (inputs[1].value == 0))
        case "pow":
            return ~inputs[1].nonzero
        case "integer_pow" if eqn.params["y"] == 0:
            return True
    return False


def _values(eqn: Equation, inputs: list[Cells], settled: np.ndarray) -> np.ndarray:
    """The numbers of the known entries; the others are arbitrary."""
    name, aval = eqn.primitive.name, eqn.outvars[0].aval
    values = [broadcast(cells.value, aval.shape) for cells in inputs]
    with np.errstate(all="ignore"):
        if name == "convert_element_type":
            result = values[0].astype(aval.dtype)
        elif name == "stop_gradient":
            result = values[0]
        else:
            result = on_numbers(eqn, values)
            result = np.asarray(evaluate(eqn, values)[0]) if result is None else result
    result = broadcast(result, aval.shape)
    if not settled.any():
        return result
    return np.where(settled, np.asarray({"mul": 0, "and": 0, "div": 0}.get(name, 1), aval.dtype), result)


def select_n(eqn: Equation, inputs: list[Cells], sets: Sets) -> list[Cells]:
    """Where the predicate is known the chosen case alone; elsewhere any case and the predicate."""
    predicate, *cases = inputs
    shape = eqn.outvars[0].aval.shape
    which = np.broadcast_to(predicate.value, shape).astype(int)
    either = cases[0]
    for case in cases[1:]:
        either = either.join(case, sets)
    either = either.also(predicate.dependence, sets)
    chosen_known = np.broadcast_to(predicate.known, shape)
    if not chosen_known.any():
        return [either]
    parts = []
    for field in Cells.__slots__:
        chosen = getattr(cases[0], field)
        for number, case in enumerate(cases[1:], start=1):
            chosen = np.where(which == number, getattr(case, field), chosen)
        parts.append(np.where(chosen_known, chosen, getattr(either, field)))
    return [Cells(*parts)]


def _broadcast_in_dim(a: np.ndarray, p: dict[str, Any]) -> np.ndarray:
    shape = [1] * len(p["shape"])
    for axis, extent in zip(p["broadcast_dimensions"], a.shape, strict=True):
        shape[axis] = extent
    return np.broadcast_to(a.reshape(shape), p["shape"])


def _slice(a: np.ndarray, p: dict[str, Any]) -> np.ndarray:
    strides = p["strides"] or (1,) * a.ndim
    return a[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]


MOVEMENT: dict[str, Callable[[np.ndarray, dict[str, Any]], np.ndarray]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda a, p: a.reshape(p["new_sizes"]),
    "rev": lambda a, p: np.flip(a, p["dimensions"]),
    "slice": _slice,
    "squeeze": lambda a, p: np.squeeze(a, tuple(p["dimensions"])),
    "tile": lambda a, p: np.tile(a, p["reps"]),
    "transpose": lambda a, p: a.transpose(p["permutation"]),
}

IDENTITY = frozenset(
    ["device_put", "layout_constraint", "name", "optimization_barrier", "pvary", "sharding_constraint"]
)


def movement(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """Entries of one operand at other places."""
    move = MOVEMENT[eqn.primitive.name]
    return [inputs[0].map(lambda a: move(a, eqn.params))]


def concatenate(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """Operands one after the other along an axis."""
    return [together(lambda arrays: np.concatenate(arrays, eqn.params["dimension"]), inputs)]


def stack(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """Operands one after the other along a new axis."""
    return [together(lambda arrays: np.stack(arrays, eqn.params["axis"]), inputs)]


def unstack(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """The slices of an operand along an axis."""
    axis = eqn.params["axis"]
    return [inputs[0].map(lambda a, i=i: np.moveaxis(a, axis, 0)[i, ...]) for i in range(len(eqn.outvars))]


def split(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """An operand cut along an axis."""
    ends = np.cumsum(eqn.params["sizes"])[:-1]
    pieces = [np.split(getattr(inputs[0], field), ends, eqn.params["axis"]) for field in Cells.__slots__]
    return [Cells(*piece) for piece in zip(*pieces, strict=True)]


def pad(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """An operand with a padding value before, after and between its entries; negative padding cuts."""
    operand, filling = inputs
    config = eqn.params["padding_config"]
    shape = eqn.outvars[0].aval.shape

    def place(a: np.ndarray, fill: np.ndarray) -> np.ndarray:
        spread = [max(0, e + (e - 1) * gap) for e, (_, _, gap) in zip(a.shape, config, strict=True)]
        out = np.full(spread, fill, a.dtype)
        out[tuple(slice(None, None, gap + 1) for _, _, gap in config)] = a
        ends = [(max(0, low), max(0, high)) for low, high, _ in config]
        wide = np.full([low + e + high for e, (low, high) in zip(spread, ends, strict=True)], fill, a.dtype)
        wide[tuple(slice(low, low + e) for e, (low, _) in zip(spread, ends, strict=True))] = out
        return wide[tuple(slice(max(0, -low), max(0, -low) + e) for e, (low, _, _) in zip(shape, config, strict=True))]

    return [Cells(*(place(getattr(operand, field), getattr(filling, field)) for field in Cells.__slots__))]


def iota(eqn: Equation, inputs: list[Cells]) -> list[Cells]:
    """0, 1, 2, ... along an axis."""
    del inputs
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    column = np.arange(shape[axis]).reshape([-1 if d == axis else 1 for d in range(len(shape))])
    return [Cells.constant(np.broadcast_to(column, shape).astype(eqn.params["dtype"]))]


def together(combine: Callable[[list[np.ndarray]], np.ndarray], inputs: list[Cells]) -> Cells:
    """One `Cells` of many, each of the arrays combined."""
    return Cells(*(combine([getattr(cells, field) for cells in inputs]) for field in Cells.__slots__))
