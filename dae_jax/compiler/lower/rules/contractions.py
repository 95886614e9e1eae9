"""The rule of products of matrices."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...jaxprs.objects import objects
from ...thresholds import THRESHOLDS
from ...types import Equation
from ..arithmetic import combined, convert, total
from ..arrays import Operand, View
from ..context import Context
from ..dtypes import NUMBERS
from ..registry import rule
from ..values import Index
from .reductions import folded, in_pairs


def _cost(eqn: Equation) -> int:
    (contracted, _), _ = eqn.params["dimension_numbers"]
    return 2 * eqn.outvars[0].aval.size * math.prod(eqn.invars[0].aval.shape[d] for d in contracted)


# (contracted axes, batch axes) of both operands.
DotNumbers = tuple[tuple[Sequence[int], Sequence[int]], tuple[Sequence[int], Sequence[int]]]


@rule("dot_general", NUMBERS, cost=_cost)
def dot_general(context: Context, a: Operand, b: Operand, *, dimension_numbers: DotNumbers, **_: object) -> Any:
    """A product of matrices, summed over the contracted indices in turn."""
    if context.large:
        return _in_memory(context, context.view(a, 0), context.view(b, 1), dimension_numbers)
    (of_a, of_b), (batch_a, batch_b) = dimension_numbers
    a, b = (
        _matrices(_converted(context, context.entries(a), 0), batch_a, of_a),
        _matrices(_converted(context, context.entries(b), 1), batch_b, of_b),
    )
    product = functools.partial(combined, context.code, "mul", context.to)
    plus = functools.partial(total, context.code, context.to)
    zero = np.zeros((), context.to)[()]
    out = [
        functools.reduce(plus, map(product, row, column), zero)
        for rows, columns in zip(a, b, strict=True)
        for row in rows
        for column in columns
    ]
    return objects(out, context.out.shape)


def _converted(context: Context, x: np.ndarray, k: int) -> np.ndarray:
    return objects([convert(context.code, e, context.dtypes[k], context.to) for e in x.ravel()], x.shape)


def _matrices(x: np.ndarray, batch: Sequence[int], contract: Sequence[int]) -> np.ndarray:
    """`x` as (batch, free, contracted), each in row-major order."""
    free = [i for i in range(x.ndim) if i not in batch and i not in contract]
    count = [math.prod(x.shape[i] for i in dims) for dims in (batch, free, contract)]
    return np.transpose(x, (*batch, *free, *contract)).reshape(count)


def _in_memory(context: Context, a: View, b: View, dimension_numbers: DotNumbers) -> View:
    dtype, zero = context.to, context.to.type(0)
    extents = [a.shape[d] for d in dimension_numbers[0][0]]
    term = _term(context, a, b, dimension_numbers)
    if math.prod(extents) <= THRESHOLDS.carried:
        plus = functools.partial(combined, context.code, "add", dtype)
        entry = lambda index: in_pairs(plus, [term(index, of) for of in np.ndindex(*extents)] or [zero])
    else:
        entry = lambda index: folded(context, "add", extents, zero, functools.partial(term, index))
    return context.memory.made(dtype, context.out.shape, entry)


def _term(
    context: Context, a: View, b: View, dimension_numbers: DotNumbers
) -> Callable[[Sequence[Any], Sequence[Any]], Any]:
    """The product of two entries, by the index of the result and the contracted one."""
    (of_a, of_b), (batch_a, batch_b) = dimension_numbers
    free_a = [d for d in range(a.ndim) if d not in (*of_a, *batch_a)]
    free_b = [d for d in range(b.ndim) if d not in (*of_b, *batch_b)]
    n, m = len(batch_a), len(free_a)

    def number(x: View, where: Sequence[tuple[Sequence[int], Sequence[Any]]]) -> Any:
        found = dict(pair for dims, values in where for pair in zip(dims, values, strict=True))
        entry = context.memory.entry(x, [found[d] for d in range(x.ndim)])
        return convert(context.code, entry, x.dtype, context.to)

    def term(index: Sequence[Index], inner: Sequence[Index]) -> Any:
        batch, rows, columns = index[:n], index[n : n + m], index[n + m :]
        left = number(a, ((batch_a, batch), (free_a, rows), (of_a, inner)))
        return combined(
            context.code, "mul", context.to, left, number(b, ((batch_b, batch), (free_b, columns), (of_b, inner)))
        )

    return term
